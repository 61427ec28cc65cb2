"""Comparison of artifacts with their provenance, and of the provenance with the plan of a run.

Snakemake compares times and its own metadata. It does not detect a file that was deleted from a folder or
an unfinished output of a killed job, and it detects nothing if its metadata is lost.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import provenance_path, run_command, sha256_of_path, was_interrupted
from hilsplat.base.errors import ArtifactError, HilsplatError
from hilsplat.base.progress import track
from hilsplat.base.provenance import Provenance, files_of, read_provenance, sizes_of
from hilsplat.baselines import OURS
from hilsplat.datasets.sources import is_exported
from hilsplat.models.store import model_digest
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.scene_data import of_variant
from hilsplat.workflow.stages import stage_code
from hilsplat.workflow.targets import tables

IMPORTED = "langsplat"
"""Stage of imported artifacts, which replace a stage's output; no settings of the plan apply to them."""

SHARED = ("masks", "coverage_tree", "clip", "contributions", "semantic_tree", "autoencoder", "field")
"""Stages whose outputs variants share."""

WHOLE, STALE, DAMAGED = "whole", "stale", "damaged"


@dataclass(frozen=True)
class Expected:
    """How a plan makes an artifact.

    Attributes:
        output: an output declared by the rule, if the rule does not declare the artifact itself.
        seed: seed expected in the provenance; None if the artifact is deterministic.
        plugins: readers or baselines that are part of the code digest.
    """

    stage: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    plugins: tuple[str, ...] = ()
    output: str = ""


def expected_artifacts(plan: Plan) -> dict[str, Expected]:
    """Map the path of each artifact that the run can write to how the plan makes it."""
    found: dict[str, Expected] = {}
    for row in plan.scenes:
        readers = plan.data.label_readers(row)

        def add(name: str, stage: str, job: Any, **how: Any) -> None:
            variant = [job.variant] if hasattr(job, "variant") else []
            how.setdefault("settings", plan.values(stage, job))
            found.setdefault(plan.path(job, *variant, name), Expected(stage, **how))

        if row.world:
            add("world", "world", row, output=plan.path(row, "world/images"))
        if is_exported(row.source):
            add("source", "source", row, plugins=plan.data.source_reader(row))
        add("scene", "poses", row, seed=plan.run.seed)
        add("gaussians.ply", "gaussians", row, seed=plan.run.seed)
        for variant in plan.run.variant_names():
            own = of_variant(row, variant)
            for stage in SHARED:
                job = of_variant(row, plan.shared_variant(stage, own))
                settings, seed = plan.stages(job), plan.seed(job)
                if stage == "masks" and plan.masks_stage(job) == "truth_masks":
                    both = {name: plan.values(name, job) for name in ("masks", "perturb")}
                    add("masks", "truth_masks", job, seed=settings.perturb.seed, settings=both)
                elif stage == "masks":
                    add("masks", plan.masks_stage(job), job, settings=plan.values("masks", job))
                elif stage == "field" and settings.method.name != OURS:
                    add("field.safetensors", "method", job, seed=seed, plugins=plan.baseline(job))
                elif stage == "field":
                    add("field.safetensors", "field", job, seed=seed if settings.field.is_random else None)
                elif stage == "semantic_tree" and plan.tree_stage(job) == "feature_tree":
                    both = {name: plan.values(name, job) for name in ("semantic_tree", "field")}
                    add("semantic_tree", "feature_tree", job, seed=seed, settings=both)
                else:
                    add(stage, stage, job, seed=seed if stage == "autoencoder" else None)
            add("scores.csv", "evaluate", own, plugins=readers)
        words = {name: plan.values(name, row) for name in ("query", "evaluate")}
        found[plan.path(row, "default/names")] = Expected("names", words)
        drawn = {name: plan.values(name, row) for name in ("figures", "evaluate")}
        figures = f"{plan.run.results}/figures/{row.name}"
        found[f"{figures}/panel.png"] = Expected("figures", drawn, None, readers)
        found[f"{figures}/comparison.png"] = Expected("comparison", drawn, None, readers)
        found[f"{figures}/masks.png"] = Expected("mask_truth")
    return found | {table: Expected("table") for table in tables(plan)}


def outdated(plan: Plan, *, every_byte: bool = False) -> dict[str, str]:
    """Map each existing output that must be rebuilt to the reason.

    Without `every_byte`, contents are compared only if a job did not finish or a file is newer than its
    record; otherwise, sizes are compared.
    """
    expected = expected_artifacts(plan)
    records = Records(plan.results, every_byte=every_byte)
    found = {}
    for path, how in expected.items():
        if provenance_path(Path(path)).is_file() or Path(how.output or path).exists():
            state, reason = records.state(Path(path), how)
            if state != WHOLE:
                found[how.output or path] = reason
    return found


def verify(results: Path) -> tuple[str, bool]:
    """Read every byte of a results folder, or a copy of it, and compare it with the provenance.

    An artifact is damaged if its files differ from what was written. It is stale if its code
    or inputs have changed. Missing inputs outside the folder are ignored.

    Returns:
        A report that ends with the repairing command, and whether all artifacts are whole.

    Raises:
        ArtifactError: the folder contains no artifacts.
    """
    results = Path(results)
    paths = sorted(path for path in results.rglob("*.provenance.json") if ".cache" not in path.parts)
    if not paths:
        raise ArtifactError(
            f"{results} contains no artifacts", expected="a results folder with *.provenance.json files"
        )
    counts, lines, records = Counter[str](), [], Records(results, every_byte=True)
    for path in track(paths, "artifacts read"):
        artifact = path.with_name(path.name.removesuffix(".provenance.json"))
        state, reason = records.state(artifact)
        counts[state] += 1
        if state != WHOLE:
            lines.append(f"{state:<8} {artifact}: {reason}")
    states = ", ".join(f"{counts[state]} {state}" for state in (WHOLE, STALE, DAMAGED) if counts[state])
    lines.append(f"{len(paths)} artifacts in {results}: {states}")
    is_whole = counts[WHOLE] == len(paths)
    if not is_whole:
        lines.append(f"to rebuild them, in the project that made them: {run_command(results, '--verify')}")
    return "\n".join(lines), is_whole


class Records:
    """Comparison of artifacts' provenance with their files.

    Args:
        results: results folder; provenance refers to it as `results/...`, even if the folder was moved.
        every_byte: compare all contents; otherwise, those of files newer than their record.
    """

    def __init__(self, results: Path, *, every_byte: bool) -> None:
        self.results = results
        self.every_byte = every_byte
        self._digests: dict[Path, str | None] = {}

    def state(self, artifact: Path, expected: Expected | None = None) -> tuple[str, str]:
        """Return an artifact's state and, if it is not whole, the reason.

        Without `expected`, only code and inputs are compared."""
        try:
            record = read_provenance(artifact)
        except ArtifactError:
            return DAMAGED, "its provenance is damaged"
        if record is None:
            return DAMAGED, "it has no provenance"
        if damage := self._damage(artifact, record):
            return DAMAGED, damage
        reason = next(self._differences(record, expected), "")
        return (STALE if reason else WHOLE), reason

    def _damage(self, artifact: Path, record: Provenance) -> str | None:
        """Return the first file that is missing or differs from what was written, or None."""
        for name, written in record.outputs.items():
            path, sizes = artifact.parent / name, written.bytes
            if not path.exists():
                return f"{path.name} is missing"
            found = sizes_of(path)
            if gone := sorted(sizes.keys() - found.keys()):
                return f"{gone[0]} is missing from {path.name}"
            if wrong := sorted(file for file in found if sizes.get(file) != found[file]):
                return f"{path.name if wrong[0] == '.' else wrong[0]} was changed after it was written"
            written_ns = provenance_path(artifact).stat().st_mtime_ns
            is_older = all(file.stat().st_mtime_ns <= written_ns for file in files_of(path))
            if not self.every_byte and is_older and not was_interrupted(artifact):
                self._digests[path] = written.sha256
            elif self._digest(path) != written.sha256:
                return f"{path.name} was changed after it was written"
        return None

    def _differences(self, record: Provenance, expected: Expected | None) -> Iterator[str]:
        """Yield differences between an artifact's provenance and the plan, and changes of its inputs."""
        stage, plugins = record.stage, record.plugins
        if expected is not None and stage != IMPORTED:
            if stage != expected.stage:
                yield f"it was made by stage {stage}, not {expected.stage}"
            then, now = record.settings, expected.settings
            for name in sorted(then.keys() | now.keys()):
                made, configured = then.get(name), now.get(name)
                if made != configured:
                    yield f"it was made with {name} {made!r}, but the configuration has {configured!r}"
            if record.seed != expected.seed:
                yield f"it was made with seed {record.seed}, but the configuration has {expected.seed}"
            stage, plugins = expected.stage, expected.plugins
        try:
            code = stage_code(stage, plugins)
        except HilsplatError:  # this version does not have the stage or reader
            code = ""
        if code != record.code:
            yield "it was made by different code"
        for name, read in record.inputs.items():
            files = {read.path: read.sha256} if read.files is None else read.files
            for file, digest in files.items():
                recorded = Path(file)
                inside = recorded.parts[:1] in (("results",), (self.results.name,))
                path = self.results.joinpath(*recorded.parts[1:]) if inside else recorded
                known = self._digest(path) if self.every_byte else self._known_digest(name, path)
                if known != digest and (known is not None or (self.every_byte and inside)):
                    yield f"its input {name} {'is missing' if known is None else 'has changed'}: {path}"

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
