"""What `check` proposes, written into the text of a job: other lines, and comments, stay as they are."""

from __future__ import annotations

import re
import tomllib

from jaximp.identification.check import Proposal
from jaximp.jobs.job import parse_job


def with_proposal(text: str, proposal: Proposal) -> str:
    """The text of a job with the proposed cut-offs, and with the window where there is one.

    **Raises:** `ValueError` for a job in which these keys do not stand in lines of their own.
    """
    wanted = {("filter", "position_cutoff"): proposal.position_cutoff}
    wanted[("filter", "decimation_cutoff")] = proposal.decimation_cutoff
    if proposal.window is not None and "track" not in tomllib.loads(text):
        wanted[("window", "length")] = proposal.window
    for (table, key), value in wanted.items():
        text = _with_value(text, table, key, f"{value:g}")
    found = tomllib.loads(text) if _can_be_read(text) else {}
    if any(found.get(table, {}).get(key) != float(f"{value:g}") for (table, key), value in wanted.items()):
        raise ValueError("[filter] and [window] do not stand in lines of their own: write the proposal by hand")
    parse_job(text)
    return text


def _with_value(text: str, table: str, key: str, value: str) -> str:
    """With one key of one table, in its line where it has one, else below the head of its table, else at the end."""
    lines, head = text.splitlines(keepends=True), re.compile(rf"\s*\[\s*{table}\s*\]\s*(#.*)?$")
    start = next((k for k, line in enumerate(lines) if head.match(line)), None)
    if start is None:
        return f"{text.rstrip()}\n\n[{table}]\n{key} = {value}\n"
    own = re.compile(rf"(\s*{key}\s*=\s*)([^#\n]*?)(\s*(#.*)?\n?)$")
    for k in range(start + 1, len(lines)):
        if lines[k].lstrip().startswith("["):
            break
        if found := own.match(lines[k]):
            lines[k] = f"{found[1]}{value}{found[3]}"
            return "".join(lines)
    lines.insert(start + 1, f"{key} = {value}\n")
    return "".join(lines)


def _can_be_read(text: str) -> bool:
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return False
    return True
