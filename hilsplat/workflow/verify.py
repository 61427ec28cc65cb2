"""Every digest of a results folder, checked."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from hilsplat.base.artifacts import remake, sha256_of_path
from hilsplat.base.errors import ArtifactError, HilsplatError
from hilsplat.base.progress import track
from hilsplat.workflow.soundness import Record
from hilsplat.workflow.stages import stage_code

WHOLE, STALE, DAMAGED, UNKNOWN = "whole", "stale", "damaged", "unknown"


def verify(results: Path) -> tuple[str, bool]:
    """Read every byte of a results folder, and compare it with what its provenance files say.

    An artifact is damaged if its files are not what was written. It is stale if other code than this made it,
    or if its inputs have changed since. Inputs outside the folder that are gone are passed over.

    Args:
        results: the results folder, or a copy of it anywhere.

    Returns:
        a report, and whether all is whole.

    Raises:
        ArtifactError: the folder holds no artifact.
    """
    results = Path(results)
    paths = sorted(path for path in results.rglob("*.provenance.json") if ".cache" not in path.parts)
    if not paths:
        raise ArtifactError(
            f"{results} holds no artifact", expected="a results folder, with *.provenance.json in it"
        )
    states, lines, again = Counter[str](), [], []
    checked = Checked(results)
    for path in track(paths, "artifacts read"):
        artifact = path.with_name(path.name.removesuffix(".provenance.json"))
        state, reason = checked.state_of(artifact)
        states[state] += 1
        if state != WHOLE:
            lines.append(f"{state:<8} {artifact}: {reason}")
            again += [artifact] if state != UNKNOWN else []
    counts = ", ".join(
        f"{states[state]} {state}" for state in (WHOLE, STALE, DAMAGED, UNKNOWN) if states[state]
    )
    lines.append(f"{len(paths)} artifacts in {results}: {counts}")
    if again:
        names = [remake(artifact).rpartition("--forcerun ")[2] for artifact in again]
        lines.append(f"to make them again: snakemake --cores 2 --forcerun {' '.join(names)}")
    return "\n".join(lines), states[WHOLE] == len(paths)


class Checked:
    """States of the artifacts of a folder; each file is read once.

    Args:
        results: the folder. Provenance names its files as `results/...`, wherever it is now.
    """

    def __init__(self, results: Path) -> None:
        self.results = results
        self._digests: dict[Path, str | None] = {}

    def state_of(self, artifact: Path) -> tuple[str, str]:
        """State of an artifact, and why it is not whole."""
        try:
            record = Record.of(artifact)
        except ArtifactError:
            return DAMAGED, "its provenance is damaged"
        assert record is not None, artifact
        for path, digest, _ in record.outputs():
            if self._digest(path) != digest:
                return DAMAGED, record.damage(every_byte=False) or f"{path.name} is not as it was written"
        if reason := next(self._changes(record), None):
            return STALE, reason
        if "outputs" not in record.content:
            return UNKNOWN, "its provenance has no digests of what was written"
        return WHOLE, ""

    def _changes(self, record: Record) -> Iterator[str]:
        said = record.content
        try:
            code = stage_code(said["stage"], tuple(said.get("plugins", ())))
        except HilsplatError:  # a stage or a reader that this version does not have
            code = ""
        if code != said["code"]:
            yield "other code made it"
        for name, one in said["inputs"].items():
            recorded = Path(one["path"])
            inside = recorded.parts[:1] == ("results",)
            path = self.results.joinpath(*recorded.parts[1:]) if inside else recorded
            digest = self._digest(path)
            if digest != one["sha256"] and (inside or digest is not None):
                yield f"its input {name} {'is missing' if digest is None else 'has changed'}: {path}"

    def _digest(self, path: Path) -> str | None:
        """Digest of a file or folder, or None if there is none."""
        if path not in self._digests:
            try:
                self._digests[path] = sha256_of_path(path)
            except (ArtifactError, OSError):
                self._digests[path] = None
        return self._digests[path]
