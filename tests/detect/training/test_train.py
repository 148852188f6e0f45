"""Training of the networks: what does not need a run of it."""

import pytest

torch = pytest.importorskip("torch", reason="needs the extra [train]")
pytest.importorskip("ultralytics", reason="needs the extra [train]")

from detect.training.train import bfloat16_autocast  # noqa: E402


def test_weights_that_change_in_training_are_the_ones_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Autocast keeps converted weights until its context ends, which for YOLO is a whole training."""
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: True, raising=False)
    layer, inputs = torch.nn.Conv2d(1, 1, 1, bias=False), torch.ones(1, 1, 2, 2)
    with bfloat16_autocast():
        layer.weight.data.fill_(1.0)
        assert layer(inputs).dtype == torch.bfloat16
        layer.weight.data.fill_(2.0)
        assert float(layer(inputs).detach().mean()) == 2.0
