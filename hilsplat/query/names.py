"""User-given names of nodes, which queries match first, whatever the model.

`names.json` in a scene's folder stores the names under the digest of `tree.npz`, because row numbers of one
tree are meaningless in other trees. If a tree is rebuilt, the previous tree's names are kept but not used.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, NonNegativeInt

from hilsplat.base.artifacts import read_json, read_npz, write_json
from hilsplat.base.errors import ArtifactError, SettingsError, foreign
from hilsplat.base.levels import PATH_SEPARATOR, plain_text
from hilsplat.base.lineage import sha256_of_file
from hilsplat.web.file_changes import NO_FILE, replacing, version_of

FILE = "names.json"
MAX_NAME = 80  # maximum number of characters in a name
NAME_RULE = f"at most {MAX_NAME} printable characters, without the separator {PATH_SEPARATOR!r}"


def checked_name(name: str) -> str:
    """Return a name from a user or a file with single spaces; raise ValueError if it breaks `NAME_RULE`."""
    name = " ".join(name.split())
    if len(name) > MAX_NAME or PATH_SEPARATOR in name or not name.isprintable():
        raise ValueError(f"{name!r} is not a valid name")
    return name


@dataclass(frozen=True)
class NodeNames:
    """Names of one semantic tree's nodes, by row, and the version of the file they were read from."""

    of_node: Mapping[int, str] = field(default_factory=dict)
    version: str = NO_FILE

    def nodes_of(self, text: str) -> list[int]:
        """Return the nodes with this name, ignoring case and extra spaces."""
        return [node for node, name in self.of_node.items() if plain_text(name) == plain_text(text)]


def tree_digest(semantic_tree: Path) -> str:
    return sha256_of_file(Path(semantic_tree) / "tree.npz")


def read_names(folder: Path, semantic_tree: Path) -> NodeNames:
    """Return the names of a tree's nodes from the scene's folder; empty if unnamed.

    Raises:
        ArtifactError: the file is damaged, has a different format version, or names nodes that do not exist.
    """
    path = Path(folder) / FILE
    version = version_of(path)  # before the names: if these change in between, they cannot be replaced
    trees = _stored(path).trees
    names = trees.get(tree_digest(semantic_tree), {}) if trees else {}
    num_nodes = len(read_npz(Path(semantic_tree) / "tree.npz")["level"]) if names else 0
    if beyond := [node for node in names if node >= num_nodes]:
        raise ArtifactError(
            f"{path} contains names of nodes that do not exist",
            expected=f"rows 0 to {num_nodes - 1}",
            found=", ".join(map(str, beyond[:5])),
            fix="correct the file, or move it elsewhere to start without names",
        )
    return NodeNames(names, version)


def write_names(
    folder: Path, semantic_tree: Path, names: Mapping[int, str], num_nodes: int, version: str
) -> NodeNames:
    """Replace the names of a tree in the scene's folder; empty names are removed.

    Raises:
        StaleFileError: the file changed since `version` was read.
        SettingsError: a name breaks `NAME_RULE`, or a row does not exist.
    """
    path = Path(folder) / FILE
    if beyond := [node for node in names if not 0 <= node < num_nodes]:
        raise SettingsError(f"node {beyond[0]} does not exist", expected=f"0 to {num_nodes - 1}")
    try:
        checked = {node: checked_name(name) for node, name in sorted(names.items())}
    except ValueError as error:
        raise SettingsError(str(error), expected=NAME_RULE) from error
    with replacing(path, version, f"the names in {path}") as path:
        stored = _stored(path)
        stored.trees[tree_digest(semantic_tree)] = {node: name for node, name in checked.items() if name}
        write_json(path, stored.model_dump(mode="json"))
    return read_names(folder, semantic_tree)


class NamesFile(BaseModel):
    """Schema of `names.json`: digest of a tree -> row -> name."""

    model_config = ConfigDict(extra="forbid")

    format: Literal["hilsplat-names-1"]
    trees: dict[str, dict[NonNegativeInt, Annotated[str, AfterValidator(checked_name)]]]


def _stored(path: Path) -> NamesFile:
    if not path.is_file():
        return NamesFile(format="hilsplat-names-1", trees={})
    with foreign(
        path,
        ArtifactError,
        problem="is damaged or in a different format",
        expected='{"format": "hilsplat-names-1", "trees": {<digest of a tree>: {"<row>": "<name>"}}}, '
        f"with names of {NAME_RULE}",
        fix="correct the file, or move it elsewhere to start without names",
    ):
        return NamesFile.model_validate(read_json(path))
