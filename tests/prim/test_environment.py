import os

import pytest

from prim.environment import environment


def test_variables_are_set_while_a_context_lasts_and_the_users_own_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PRIM_OWN", "mine")
    monkeypatch.delenv("PRIM_NEW", raising=False)
    with environment(PRIM_OWN="ours", PRIM_NEW="ours"):
        assert (os.environ["PRIM_OWN"], os.environ["PRIM_NEW"]) == ("mine", "ours")
    assert os.environ["PRIM_OWN"] == "mine"
    assert "PRIM_NEW" not in os.environ
