"""User-given names of nodes, which queries match first and without a model.

`names.json` in a scene's folder stores the names under the digest of `tree.npz`, because row numbers of one
tree are meaningless in other trees. If a tree is rebuilt, the previous tree's names are kept but not used.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, ValidationError

from hilsplat.base.artifacts import read_json, read_npz, sha256_of_file, write_json
from hilsplat.base.errors import ArtifactError, SettingsError
from hilsplat.web.file_changes import NO_FILE, replacing, version_of

FILE = "names.json"
PATH_SEPARATOR = ">"
LONGEST = 80
"""Maximum number of characters in a name."""


@dataclass(frozen=True)
class NodeNames:
    """Names of one semantic tree's nodes, by row, and the version of the file they were read from."""

    of_node: Mapping[int, str] = field(default_factory=lambda: MappingProxyType({}))
    version: str = NO_FILE

    def nodes_of(self, text: str) -> list[int]:
        """Return the nodes with this name, ignoring case and extra spaces."""
        plain = " ".join(text.split()).casefold()
        return [node for node, name in self.of_node.items() if " ".join(name.split()).casefold() == plain]


def tree_digest(semantic_tree: Path) -> str:
    """Return the digest that identifies a semantic tree."""
    return sha256_of_file(Path(semantic_tree) / "tree.npz")


def read_names(folder: Path, semantic_tree: Path) -> NodeNames:
    """Return the names of a tree's nodes from the scene's folder; empty if unnamed.

    Raises:
        ArtifactError: the file is damaged, has a different format version, or names nodes that do not exist.
    """
    path = Path(folder) / FILE
    kept = _kept(path).trees.get(tree_digest(semantic_tree), {})
    num_nodes = len(read_npz(Path(semantic_tree) / "tree.npz")["level"]) if kept else 0
    if beyond := [node for node in kept if node >= num_nodes]:
        raise ArtifactError(
            f"{path} contains names of nodes that do not exist",
            expected=f"rows 0 to {num_nodes - 1}",
            found=", ".join(map(str, beyond[:5])),
            fix="correct the file, or move it elsewhere to start without names",
        )
    return NodeNames(MappingProxyType(kept), version_of(path))


def write_names(
    folder: Path, semantic_tree: Path, names: Mapping[int, str], num_nodes: int, version: str
) -> NodeNames:
    """Replace the names of a tree in the scene's folder; empty names are removed.

    Raises:
        StaleFileError: the file changed since `version` was read.
        SettingsError: a name is too long, contains `PATH_SEPARATOR` or is not printable, or a row is invalid.
    """
    path = Path(folder) / FILE
    given = {node: " ".join(name.split()) for node, name in names.items()}
    for node, name in given.items():
        if not 0 <= node < num_nodes:
            raise SettingsError(f"node {node} does not exist", expected=f"0 to {num_nodes - 1}")
        if len(name) > LONGEST or PATH_SEPARATOR in name or not name.isprintable():
            raise SettingsError(
                f"{name!r} is not a valid name",
                expected=f"at most {LONGEST} printable characters, without the separator {PATH_SEPARATOR!r}",
            )
    with replacing(path, version, f"the names in {path}"):
        found = _kept(path)
        found.trees[tree_digest(semantic_tree)] = {node: name for node, name in sorted(given.items()) if name}
        write_json(path, found.model_dump(mode="json"))
    return read_names(folder, semantic_tree)


class NamesFile(BaseModel):
    """Schema of `names.json`: digest of a tree -> row -> name."""

    model_config = ConfigDict(extra="forbid")

    format: Literal["hilsplat-names-1"]
    trees: dict[str, dict[NonNegativeInt, Annotated[str, Field(max_length=LONGEST)]]]


def _kept(path: Path) -> NamesFile:
    if not path.is_file():
        return NamesFile(format="hilsplat-names-1", trees={})
    try:
        return NamesFile.model_validate(read_json(path))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ArtifactError(
            f"{path} is damaged or in a different format: {'.'.join(map(str, first['loc']))}: {first['msg']}",
            expected='{"format": "hilsplat-names-1", "trees": {<digest of a tree>: {"<row>": "<name>"}}}',
            fix="correct the file, or move it elsewhere to start without names",
        ) from error
