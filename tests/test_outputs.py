"""Numbers in the documents are what the commands print."""

import pytest
from loaded_scripts import SCRIPTS, loaded

outputs = loaded("outputs")


@pytest.mark.parametrize("name", outputs.DOCUMENTS)
def test_documents_show_what_commands_print(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(SCRIPTS.parent)
    text = (SCRIPTS.parent / name).read_text()
    assert outputs.commands(text)
    assert outputs.renewed(text) == text, "run python scripts/outputs.py"


def test_what_is_not_marked_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outputs, "race", lambda words: print(" ".join(words).upper()))
    text = "before\n<!-- race show x -->\nold\n\nolder\n<!-- end of output -->\nafter 1,000\n"
    expected = "before\n<!-- race show x -->\n\nSHOW X\n\n<!-- end of output -->\nafter 1,000\n"
    assert outputs.renewed(text) == expected
    assert outputs.renewed(expected) == expected
