from prim.text import listed, printable


def test_what_a_terminal_obeys_is_made_visible() -> None:
    text = "a\x1b]0;x\x07\x9b2J\x7f\u202e\udcff\té\r\nb\x85c"
    assert printable(text) == r"a\x1b]0;x\x07\x9b2J\x7f\u202e\udcff é b c"
    assert printable("«±1σ», Größe 5 µm") == "«±1σ», Größe 5 µm"


def test_messages_list_the_first_of_many_names() -> None:
    assert listed([]) == "" and listed(["/a", "/b"]) == "/a, /b"
    assert listed(f"/{k}" for k in range(60_000)).endswith(", /18, /19 and 59,980 more")
    assert len(listed(["x" * 10**6])) == 100
