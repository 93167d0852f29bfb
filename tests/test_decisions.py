"""Each decision has a status, and names the decisions that it changed and those that changed it."""

import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "docs" / "decisions"
PAGES = {int(path.name[:4]): path for path in sorted(FOLDER.glob("0*.md"))}
EVERY_DECISION = pytest.mark.parametrize("number", PAGES)

#: Relation of a decision to another one -> relation of that one to it.
MUTUAL = {"supersedes": "superseded by", "superseded by": "supersedes", "amends": "amended by", "amended by": "amends"}


def status(number: int) -> str:
    lines = PAGES[number].read_text(encoding="utf-8").splitlines()
    found = re.fullmatch(r"Status: (.*)\.", lines[2])
    assert found, f"{PAGES[number].name}: the third line has to be its status, 'Status: accepted.' for example"
    return found[1]


def relations(number: int) -> dict[str, list[int]]:
    """Relations to other decisions: their numbers, by relation."""
    parts = (part.partition(" [") for part in status(number).split("; ") if "[" in part)
    return {word: [int(link) for link in re.findall(r"(\d+)\]\(", links)] for word, _, links in parts}


@EVERY_DECISION
def test_a_decision_is_accepted_or_superseded(number):
    said = relations(number)
    assert said.keys() <= MUTUAL.keys()
    assert ("superseded by" in said) != status(number).startswith("accepted")


@EVERY_DECISION
def test_relations_between_decisions_are_mutual(number):
    for word, others in relations(number).items():
        for other in others:
            assert number in relations(other).get(MUTUAL[word], []), f"{other} does not say: {MUTUAL[word]} {number}"
            assert f"[{other}]({PAGES[other].name})" in status(number)
            assert (other < number) == (word in ("supersedes", "amends")), "a decision changes an older one"
