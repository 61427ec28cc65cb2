"""Rows of `scores.csv`, and instance matches in `instances.npz`, which average precision pools over scans."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from hilsplat.base.artifacts import read_npz, rebuild_command, write_npz
from hilsplat.base.errors import ArtifactError, foreign
from hilsplat.base.tables import read_csv, write_csv
from hilsplat.evaluate.metrics.instances import InstanceMatches
from hilsplat.evaluate.protocols.cards import card_of

if TYPE_CHECKING:
    import pandas as pd

INSTANCES = "instances.npz"
OF_FILES = ".instances.npz"
"""Suffix of the matches that `evaluate-files` writes, beside a score file whose name begins alike."""

COLUMNS: tuple[str, ...] = (
    *("dataset", "scene", "variant", "masks", "method", "view"),
    *("query", "level", "metric", "protocol", "value", "n"),
)


@dataclass(frozen=True)
class Measured:
    """One measured number, without its scene and variant."""

    method: str  # `tree`, `tree-path`, `field`, or `truth` for the annotations' own HC
    query: str  # empty if the number describes a whole view
    level: str  # of the annotation; empty if the protocol has no levels
    metric: str
    protocol: str  # full name, with non-default settings (`protocols.cards`)
    value: float
    n: int = 1  # number of items averaged


@dataclass(frozen=True, kw_only=True)
class Score(Measured):
    """One row of a score file."""

    dataset: str
    scene: str
    variant: str
    masks: str  # origin of the masks, such as `sam-tiny`; see `made_from_truth`
    view: str


def write_scores(path: Path, scores: Iterable[Score]) -> None:
    """Write sorted rows, with six-decimal values, so that equal rows produce identical files."""
    rows = []
    for score in scores:
        assert score.metric in card_of(score.protocol).metrics, (score.metric, score.protocol)
        row = {**vars(score), "value": f"{score.value:.6f}"}
        rows.append([str(row[name]) for name in COLUMNS])
    write_csv(path, COLUMNS, sorted(rows))


def read_scores(paths: Iterable[Path]) -> "pd.DataFrame":
    """Read score files into one frame.

    Raises:
        ArtifactError: a file is missing, damaged, or has different columns.
    """
    import pandas as pd

    rows: list[dict[str, object]] = []
    for path in paths:
        records = read_csv(path, COLUMNS, fix := rebuild_command(path))
        with foreign(path, ArtifactError, fix=fix):
            rows += [{**row, "value": float(row["value"]), "n": int(row["n"])} for row in records]
    return pd.DataFrame(rows, columns=list(COLUMNS)).astype({"value": float, "n": int})


def write_instances(
    scores: Path, matches: Mapping[tuple[str, ...], InstanceMatches], name: str = INSTANCES
) -> None:
    """Write matches, keyed by (data set, scene, variant, masks, method), beside a score file."""
    arrays: dict[str, Any] = {}
    for key, of_key in matches.items():  # a program's name may contain a slash, as in "w/ SAM"
        prefix = "/".join(part.replace("%", "%25").replace("/", "%2F") for part in key)
        arrays |= {f"{prefix}/{field}": array for field, array in vars(of_key).items()}
    write_npz(Path(scores).with_name(name), **arrays)


def read_instances(scores: Iterable[Path]) -> dict[tuple[str, ...], InstanceMatches]:
    """Read the matches beside score files, keyed by (data set, scene, variant, masks, method)."""
    by_key: dict[tuple[str, ...], dict[str, Any]] = {}
    files = [file for path in scores for file in (path.with_name(INSTANCES), path.with_suffix(OF_FILES))]
    for file in filter(Path.is_file, files):
        for name, array in read_npz(file).items():
            *key, part = map(unquote, name.split("/"))
            by_key.setdefault(tuple(key), {})[part] = array
    return {key: InstanceMatches(**arrays) for key, arrays in by_key.items()}
