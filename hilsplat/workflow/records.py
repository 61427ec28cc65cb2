"""Comparison of artifacts with their provenance, and of the provenance with the plan of a run.

Snakemake compares times and its own metadata. It does not detect a file that was deleted from a folder or
an unfinished output of a killed job, and it detects nothing if its metadata is lost.
"""

import json
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import dropwhile
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import RUN, provenance_path, run_command
from hilsplat.base.atomic import was_interrupted
from hilsplat.base.errors import ArtifactError, HilsplatError
from hilsplat.base.lineage import (
    UNREADABLE,
    Provenance,
    artifacts_in,
    digests_of,
    files_of,
    read_provenance,
    sha256_of_path,
    sizes_of,
)
from hilsplat.base.progress import track
from hilsplat.models.store import model_digest
from hilsplat.stage import Stage
from hilsplat.stages import all_stages
from hilsplat.workflow import targets
from hilsplat.workflow.plan import UNCOMPARED, Plan, words_of
from hilsplat.workflow.scene_data import VariantJob, of_variant

WHOLE, STALE, DAMAGED = "whole", "stale", "damaged"

OPTIONS = ("unit", "render", "source", "dataset", "variant", "names", "queries")
"""Options of stages that are compared, besides settings; no rule replaces them, and they are no paths."""


def outdated(plan: Plan, *, every_byte: bool = False) -> dict[str, str]:
    """Map each artifact of the run that must be rebuilt to the reason.

    Snakemake finds changed settings, code and inputs, unless its own records were lost. It does not find
    damage. Without `every_byte`, contents are compared only if a job did not finish or a file is newer than
    its record; otherwise, sizes are compared.
    """
    records, artifacts = Records(plan.results, plan, every_byte=every_byte), artifacts_in(plan.results)
    declared = [path for row in plan.scenes for path in plan.artifacts(row)]
    names = [Path(stage.file).name for stage in all_stages().values()]  # inputs come before what reads them
    order = {name: number for number, name in enumerate(names)}
    paths = sorted({*artifacts, *declared}, key=lambda path: (order.get(path.name, len(order)), path))
    states = {str(path): records.state(path) for path in paths}
    return {path: reason for path, (state, reason) in states.items() if state != WHOLE}


def verify(results: Path) -> tuple[str, bool]:
    """Read every byte of a results folder, or a copy of it, and compare it with the provenance.

    An artifact is damaged if its files differ from what was written. It is stale if its code
    or inputs have changed. Missing inputs outside the folder are ignored.

    Returns:
        A report that ends with the repairing command, and whether all artifacts are whole.

    Raises:
        ArtifactError: the folder contains no artifacts.
    """
    artifacts = artifacts_in(results)
    if not artifacts:
        raise ArtifactError(
            f"{results} contains no artifacts", expected="a results folder with *.provenance.json files"
        )
    counts, lines, records = Counter[str](), [], Records(results, every_byte=True)
    for artifact in track(artifacts, "artifacts read"):
        state, reason = records.state(artifact)
        counts[state] += 1
        if state != WHOLE:
            lines.append(f"{state:<8} {artifact}: {reason}")
    states = ", ".join(f"{counts[state]} {state}" for state in (WHOLE, STALE, DAMAGED) if counts[state])
    lines.append(f"{len(artifacts)} artifacts in {results}: {states}")
    is_whole = counts[WHOLE] == len(artifacts)
    if not is_whole:
        folder = results.resolve()
        root = next((path for path in (folder, *folder.parents) if (path / RUN).is_file()), results)
        lines.append(f"to rebuild them, in the project that made them: {run_command(root, '--verify')}")
    return "\n".join(lines), is_whole


class Records:
    """Comparison of artifacts' provenance with their files.

    Args:
        results: results folder; it may have been moved since its artifacts were written.
        plan: the run that settings and seeds must equal; None to compare only code and inputs.
        every_byte: compare all contents; otherwise, those of files newer than their record.
    """

    def __init__(self, results: Path, plan: Plan | None = None, *, every_byte: bool) -> None:
        self.results, self.plan = results, plan
        self._rows = {(row.dataset, row.scene): row for row in plan.scenes} if plan else {}
        self._variants = plan.run.every_variant() if plan else []
        self.every_byte = every_byte
        self._digests: dict[Path, str | None] = {}

    def state(self, artifact: Path) -> tuple[str, str]:
        """Return an artifact's state and, if it is not whole, the reason."""
        try:
            record = read_provenance(artifact)
        except ArtifactError:
            return DAMAGED, "its provenance is damaged"
        if record is None:
            return DAMAGED, "it has no provenance"
        if damage := self._damage(artifact, record):
            return DAMAGED, damage
        reason = next(self._differences(artifact, record), "")
        return (STALE if reason else WHOLE), reason

    def _damage(self, artifact: Path, record: Provenance) -> str | None:
        """Return the first file that is missing or differs from what was written, or None."""
        for name, written in record.outputs.items():
            path, sizes = artifact.parent / name, written.bytes
            if not path.exists():
                return f"{path.name} is missing"
            current = sizes_of(path)
            if gone := sorted(sizes.keys() - current.keys()):
                return f"{gone[0]} is missing from {path.name}"
            if wrong := sorted(file for file in current if sizes.get(file) != current[file]):
                return f"{path.name if wrong[0] == '.' else wrong[0]} was changed after it was written"
            written_ns = provenance_path(artifact).stat().st_mtime_ns
            is_older = all(file.stat().st_mtime_ns <= written_ns for file in files_of(path))
            if not self.every_byte and is_older and not was_interrupted(artifact):
                self._digests[path] = written.sha256
            elif self._digest(path) != written.sha256:
                return f"{path.name} was changed after it was written"
        return None

    def _differences(self, artifact: Path, record: Provenance) -> Iterator[str]:
        """Yield differences between an artifact's provenance and the plan, and changes of its inputs."""
        stage = all_stages().get(record.stage)
        if stage is None:
            yield f"this version has no stage {record.stage}"
            return
        job = self._job_of(artifact)
        if self.plan is not None and job is not None:
            kind = self.plan.kind(stage.artifact, job).name
            if kind != stage.name:
                yield f"it was made by stage {stage.name}, not {kind}"
            for section in stage.sections.values():
                now = json.loads(self.plan.settings(section, job, UNCOMPARED))
                made = dict(record.settings.get(section, {}))
                made = {name: value for name, value in made.items() if name not in UNCOMPARED}
                if made != now:
                    yield f"it was made with {section} {made!r}, not {now!r}"
            seed = self.plan.seed(stage, job) if "seed" in stage.hints else None
            if record.seed != seed:
                yield f"it was made with seed {record.seed}, not {seed}"
            options = {name: self.plan.options[name](job) for name in OPTIONS if name in stage.hints}
            yield from self._other_options(stage, record, options)
            images, photographs = record.inputs.get("images"), self.plan.data.image_files(job)
            if images is not None and images.files is not None and isinstance(photographs, list):
                now = digests_of(photographs, self.plan.data.memo(job))
                if sorted(now.values()) != sorted(filter(None, images.files.values())):
                    yield "it was made from other photographs"  # perhaps by another project
        try:
            code = stage.code_digest(record.plugins)
        except HilsplatError:  # this version does not have the reader
            code = ""
        if code != record.code:
            yield "it was made by different code"
        written, paths = self._written_results(artifact, record), set[str]()
        for name, read in record.inputs.items():
            files = {read.path: read.sha256} if read.files is None else read.files
            outside = [file for file in files if not Path(file).is_relative_to(written)]
            if self.plan is not None and job is not None and not self.every_byte and name != "model":
                found = digests_of(outside, self.plan.data.memo(job))
                self._digests |= {Path(file): found[file] for file in outside if found[file] != UNREADABLE}
            for file, digest in files.items():
                inside = Path(file).is_relative_to(written)
                path = self.results / Path(file).relative_to(written) if inside else Path(file)
                paths |= {str(path)} if inside else set()
                known = self._digest(path) if self.every_byte else self._known_digest(name, path)
                if known != digest and (known is not None or (self.every_byte and inside)):
                    yield f"its input {name} {'is missing' if known is None else 'has changed'}: {path}"
        if self.plan is not None and str(artifact) in targets.tables(self.plan):
            if paths != {*targets.scores(self.plan, artifact.stem)}:
                yield "it was made from other scores"
            yield from self._other_options(stage, record, {"labels": self.plan.names(None)})

    @staticmethod
    def _other_options(
        stage: Stage[..., Any], record: Provenance, options: Mapping[str, Any]
    ) -> Iterator[str]:
        """Yield a difference for each option that the recorded command, if any, does not have."""
        for name in options if record.command else ():
            words = shlex.split(words_of(stage, {name: options[name]}))
            after = [*dropwhile(f"--{name}".__ne__, record.command)]
            if after[: max(1, len(words))] != words:
                yield f"it was made with another --{name}"

    def _written_results(self, artifact: Path, record: Provenance) -> Path:
        """Return the results folder as an artifact's writer named it, given by the option `--out`."""
        words, relative = record.command, artifact.relative_to(self.results).parts
        out = Path(words[words.index("--out") + 1]).parts if "--out" in words[:-1] else ()
        return Path(*out[: -len(relative)]) if out[-len(relative) :] == relative else Path("results")

    def _job_of(self, artifact: Path) -> VariantJob | None:
        """Return the job of an artifact that belongs to a scene of the plan."""
        parts = artifact.relative_to(self.results).parts
        dataset, scene, variant, *_ = (*(parts[1:] if parts[0] == "figures" else parts), "", "", "")
        row = self._rows.get((dataset, scene))
        return of_variant(row, variant if variant in self._variants else "default") if row else None

    def _digest(self, path: Path) -> str | None:
        """Return the digest of a file or folder, or None if it does not exist or cannot be read."""
        if path not in self._digests:
            try:
                self._digests[path] = sha256_of_path(path)
            except (ArtifactError, OSError):
                self._digests[path] = None
        return self._digests[path]

    def _known_digest(self, name: str, path: Path) -> str | None:
        """Return the known digest of an artifact or model; None if only Snakemake tracks it."""
        if name == "model" and path.is_dir():
            return model_digest(path, self.results / ".cache")
        return self._digests.get(path)
