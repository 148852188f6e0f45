from prim.text import printable


def test_what_a_terminal_obeys_is_made_visible() -> None:
    text = "a\x1b]0;x\x07\x9b2J\x7f\u202e\udcff\té\r\nb\x85c"
    assert printable(text) == r"a\x1b]0;x\x07\x9b2J\x7f\u202e\udcff é b c"
    assert printable("«±1σ», Größe 5 µm") == "«±1σ», Größe 5 µm"
