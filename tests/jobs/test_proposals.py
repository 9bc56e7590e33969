"""What `check` proposes, written into a job's text."""

from __future__ import annotations

import tomllib

import pytest

from jaximp.identification.check import Proposal
from jaximp.jobs.proposals import with_proposal

PROPOSAL = Proposal(40.0, 20.0, 2.0, "in the test")
HEAD = """# what the lab recorded
[recording]
file = "a.csv"
time = "t"
position = "q"
torque = "tau"
[model]
human = true
"""


@pytest.mark.parametrize(
    "tables",
    [
        "",
        "[filter]\n",
        "[window]\nlength = 5 # s\n[filter]\nposition_cutoff = 90  # Hz\n",
        "[ filter ] # both sides\ndecimation_cutoff=9\n\n[window]\nmin_velocity = 0.1\n",
    ],
)
def test_only_what_is_proposed_changes(tables: str) -> None:
    before = HEAD + tables
    after = with_proposal(before, PROPOSAL)
    found, expected = tomllib.loads(after), tomllib.loads(before)
    expected.setdefault("filter", {}).update(position_cutoff=40, decimation_cutoff=20)
    expected.setdefault("window", {}).update(length=2)
    assert found == expected
    comments = [line.partition("#")[2] for line in before.splitlines() if "#" in line]
    assert all(comment in after for comment in comments)
    assert with_proposal(after, PROPOSAL) == after


def test_a_path_gets_no_window() -> None:
    assert "window" not in tomllib.loads(with_proposal(HEAD + "[track]\n", PROPOSAL))


@pytest.mark.parametrize("tables", ["filter = { position_cutoff = 3 }\n", "filter.position_cutoff = 3\n"])
def test_tables_of_another_form_are_left_to_the_writer(tables: str) -> None:
    with pytest.raises(ValueError, match="write the proposal by hand"):
        with_proposal(tables + HEAD, PROPOSAL)
