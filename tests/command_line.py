"""The command line, run in this process."""

import sys

import pytest

from jaximp.cli import main as cli


def jaximp(*arguments: object) -> int:
    """Run `jaximp ...`: its exit status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", "")
        patch.setattr(sys, "argv", ["jaximp", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
    return int(stopped.value.code or 0)
