"""A robot's job -> its URDF with identified links."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

from jaximp.consistency.export import Exported, export_urdf
from jaximp.consistency.programs import ConsistentFit, Ranges, consistent_fit, consistent_ranges
from jaximp.identification.estimates import Estimates
from jaximp.identification.identify import in_windows
from jaximp.identification.whole import whole_recording
from jaximp.jobs.job import Job, TrialsJob
from jaximp.jobs.run import prepare
from jaximp.models.chain import Chain
from jaximp.results import Column
from jaximp.types import Progress


@dataclass(frozen=True, eq=False)
class IdentifiedRobot:
    """A URDF that was written, and what is behind its numbers."""

    estimates: Estimates
    """Of the base parameters."""
    nearest: ConsistentFit
    """The robot whose links are real bodies and that is nearest to them."""
    ranges: Ranges
    """Between which values standard parameters lie over all robots within the errors."""
    exported: Exported

    def columns(self) -> list[Column]:
        """A row for each standard parameter: value, that of the original file, range, and where it comes from."""
        *first, source = self.exported.columns()
        return [*first, Column("low", "", self.ranges.low), Column("high", "", self.ranges.high), source]

    def write_table(self, path: Path) -> None:
        """As a CSV file."""
        columns = self.columns()
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow([column.name for column in columns])
            writer.writerows(zip(*(column.values for column in columns), strict=True))

    def in_words(self) -> list[str]:
        """What must be known of these numbers: verdicts, real bodies, masses, and what the data determined."""
        found, names = self.estimates, self.estimates.names
        doubted = [name for name in names if not found.trusted_in(name).all()]
        lines = [f"residual: {found.residuals.total:.2%} of the torque of all joints"] if found.residuals else []
        if doubted:
            share = f"{len(doubted)} of {len(names)} base parameters"
            lines.append(f"{share} cannot be trusted by themselves: jaximp identify says why")
        lines.append(
            f"the nearest robot of real bodies is {self.nearest.distance:.2g} standard errors from the estimate"
        )
        marks = self.exported.source
        by_data, written = marks.count("data"), marks.count("data") + marks.count("prior")
        lines += [line for line in self.ranges.in_words() if line in self.ranges.notes or line.startswith("mass of")]
        lines.append(f"of {written} numbers the data determined {by_data}; the others are kept from the file")
        return lines


def export_robot(job: Job, out: Path, progress: Progress = lambda share: None) -> IdentifiedRobot:
    """Identify the robot of a job over its whole recording, find the nearest whose links are real bodies, and write its
    URDF.

    **Raises:** `ValueError` with one line that names the cause and the remedy: a job without `[model.robot]` and a
    `urdf`, with several windows, or whose recording does not determine all parameters; and as `export_urdf`.
    """
    if isinstance(job, TrialsJob) or job.model.chain is None:
        raise ValueError("only a robot from a URDF can be written as one: give [model.robot] a urdf")
    if job.model.tip is not None:
        raise ValueError("a robot is exported from a recording of it alone: leave out [model.human]")
    prepared = prepare(job)
    progress(0.3)
    estimates = in_windows(prepared, lambda share: progress(0.3 + 0.3 * share))[0]
    whole, chain = whole_recording(prepared, estimates.fit), prepared.model
    assert isinstance(chain, Chain)
    nearest = consistent_fit(chain, whole.theta, whole.covariance)
    progress(0.7)
    ranges = consistent_ranges(chain, whole.theta, whole.covariance, progress=lambda share: progress(0.7 + 0.3 * share))
    source = job.folder / job.model.chain.urdf
    return IdentifiedRobot(
        estimates, nearest, ranges, export_urdf(source, chain, nearest.standard, ranges.determined, out)
    )
