"""Whether artifacts are what their provenance says and what the plan wants, whatever Snakemake remembers.

Snakemake goes by times and by its own records (`.snakemake/metadata`). Both miss what a job wrote that
outlived its Snakemake, a file that was deleted inside a folder, and everything once the records are lost.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import lock_path, provenance_path, read_json, sha256_of_path
from hilsplat.base.errors import ArtifactError
from hilsplat.base.provenance import sizes_of
from hilsplat.workflow.stages import stage_code

BROUGHT = "langsplat"
"""Stage of artifacts that a person imported in place of a stage's: no settings of the plan made them."""


@dataclass(frozen=True)
class Wanted:
    """An artifact of the plan, and how it is to be made.

    Attributes:
        artifact: the path that its provenance stands beside.
        output: one of the files and folders that its rule declares.
        stage: key of `STAGES`.
        settings: as its provenance should record them.
        seed: likewise; None if nothing of the stage is random.
        plugins: readers or baselines that its code digest covers.
    """

    artifact: Path
    output: str
    stage: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    plugins: tuple[str, ...] = ()


@dataclass(frozen=True)
class Record:
    """What the provenance of an artifact says; `problem` if it cannot be read.

    Attributes:
        artifact: the path that it stands beside.
        content: the JSON object.
    """

    artifact: Path
    content: Mapping[str, Any]

    @staticmethod
    def of(artifact: Path) -> "Record | None":
        """The provenance beside an artifact, or None.

        Raises:
            ArtifactError: it is damaged.
        """
        path = provenance_path(artifact)
        if not path.is_file():
            return None
        content = read_json(path)
        parts = {"stage": str, "code": str, "settings": dict, "inputs": dict}
        if not isinstance(content, dict) or any(
            not isinstance(content.get(name), kind) for name, kind in parts.items()
        ):
            raise ArtifactError(f"{path} is not a provenance")
        return Record(Path(artifact), content)

    def outputs(self) -> Iterator[tuple[Path, str, dict[str, int]]]:
        """Path, digest and bytes per file of everything that the stage wrote."""
        for name, said in self.content.get("outputs", {}).items():
            yield self.artifact.parent / name, said["sha256"], said["bytes"]

    def damage(self, *, every_byte: bool) -> str | None:
        """What is missing or cut; every byte is read if asked, or if the last job did not reach its end."""
        lock = lock_path(self.artifact)
        every_byte = every_byte or (lock.is_file() and lock.stat().st_size > 0)
        for path, digest, sizes in self.outputs():
            if not path.exists():
                return f"{path.name} is missing"
            found = sizes_of(path)
            if gone := sorted(sizes.keys() - found.keys()):
                return f"{gone[0]} is missing in {path.name}"
            if wrong := sorted(name for name in found if sizes.get(name) != found[name]):
                return f"{path.name if wrong[0] == '.' else wrong[0]} is not as it was written"
            if every_byte and sha256_of_path(path) != digest:
                return f"{path.name} is not as it was written"
        return None


def unsound(
    wanted: Collection[Wanted], cache: Path, *, compare_settings: bool = True, compare_inputs: bool = True
) -> dict[str, str]:
    """Outputs that must be made again although they exist, and those that others were made from -> why.

    Digests of files are not computed here, except after a job that did not reach its end: `hilsplat verify`
    does that. What has not been made yet is left to Snakemake.

    Args:
        wanted: the artifacts of the plan.
        cache: folder of the digests of models.
        compare_settings: whether other settings, seeds or code count.
        compare_inputs: whether other inputs count.
    """
    found: dict[str, str] = {}
    records: dict[str, Record] = {}
    by_artifact = {str(each.artifact): each for each in wanted}
    for each in wanted:
        try:
            record = Record.of(each.artifact)
        except ArtifactError:
            found[each.output] = "its provenance is damaged"
            continue
        if record is None:
            if Path(each.output).exists():
                found[each.output] = "it has no provenance"
            continue
        records[each.output] = record
        reason = record.damage(every_byte=False)
        if reason is None and compare_settings and record.content["stage"] != BROUGHT:
            reason = _other_settings(each, record)
        if reason is not None:
            found[each.output] = reason
    digests = {str(path): digest for record in records.values() for path, digest, _ in record.outputs()}
    for output, record in records.items():
        for name, said in record.content["inputs"].items() if compare_inputs else ():
            path = said["path"]
            if not Path(path).exists() and path in by_artifact:
                found.setdefault(by_artifact[path].output, f"it is missing, and {output} was made from it")
            elif _digest_now(name, path, digests, cache) not in (None, said["sha256"]):
                found.setdefault(output, f"it was made from another {path}")
    return found


def _other_settings(wanted: Wanted, record: Record) -> str | None:
    """How an artifact was made otherwise than the plan wants it."""
    said = record.content
    if said["stage"] != wanted.stage:
        return f"stage {said['stage']} made it, not {wanted.stage}"
    names = sorted(wanted.settings.keys() | said["settings"].keys())
    for name in names:
        now, then = wanted.settings.get(name), said["settings"].get(name)
        if now != then:
            return f"it was made with {name} {then!r}, and the configuration says {now!r}"
    if said.get("seed") != wanted.seed:
        return f"it was made with seed {said.get('seed')}, and the configuration says {wanted.seed}"
    return None if said["code"] == stage_code(wanted.stage, wanted.plugins) else "other code made it"


def _digest_now(name: str, path: str, digests: Mapping[str, str], cache: Path) -> str | None:
    """Digest of an input as it is now; None where only Snakemake watches it, by time."""
    from hilsplat.workflow.model_digests import model_digest

    if name == "model" and Path(path).is_dir():
        return model_digest(Path(path), cache)
    return digests.get(path)
