"""Request models of the page; they check shapes, sizes and finiteness."""

import base64
from typing import Annotated, Literal

import numpy as np
from jaxtyping import UInt8
from pydantic import Field, field_validator, model_validator

from hilsplat.base.errors import SettingsError
from hilsplat.base.levels import MAX_TEXT
from hilsplat.query.hits import NodeGroup
from hilsplat.scene.cameras import Camera
from hilsplat.web.messages import MAX_SIDE_PX, Message

Place = Annotated[float, Field(ge=-4 * MAX_SIDE_PX, le=4 * MAX_SIDE_PX)]
Row3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
LevelName = Literal["auto", "whole", "part", "subpart"]
Answerer = Literal["tree", "field"]

MAX_NODES = 131_071
"""Maximum number of nodes that the page shows: the table of a style must fit into `MAX_BODY_BYTES`."""

Nodes = Annotated[list[Annotated[int, Field(ge=0)]], Field(max_length=MAX_NODES)]

MAX_GAUSSIANS = 10_000_000
"""Maximum number of Gaussians; more do not fit in textures of 4096 x 16384 texels (degree 3: four texels per
Gaussian) or a few GiB of memory."""

Bits = Annotated[str, Field(max_length=(MAX_GAUSSIANS // 8 // 3 + 1) * 4)]
"""Base64 of one bit per Gaussian in the page's order, least significant bit first; empty if no bit is set."""

MAX_BODY_BYTES = 4 << 20
"""Maximum size of a request: the table of a style, and the marks of two sets of Gaussians."""

Side = Annotated[int, Field(ge=1, le=2 * MAX_SIDE_PX)]  # of a page's view, which may exceed a picture's limit


class WireCamera(Message):
    """A camera with OpenCV axes; the centre of the top-left pixel is at (0.5, 0.5)."""

    cam_from_world: tuple[Row4, Row4, Row4, Row4]
    K: tuple[Row3, Row3, Row3]
    size_hw: tuple[Side, Side]

    def camera(self) -> Camera:
        """Return the camera as the package's type; raise SceneError if it is impossible."""
        return Camera("page", np.array(self.cam_from_world), np.array(self.K), self.size_hw)


class Style(Message):
    """Colours of Gaussians by the node that they belong to; see `frames.painted`.

    Attributes:
        table: base64 of RGBA bytes: row 0 for Gaussians without a node, row n + 1 for node n.
        use: whether each level is used; the finest used level with an alpha above 0 sets the colour.
        mode: style of Gaussians whose alpha is 0.
        ramp: base64 of 256 RGB colours; if given, colours show the field's relevancy to `text` at `level`.
        marked: Gaussians that the user has selected for editing.
    """

    table: Annotated[str, Field(max_length=6 * (MAX_NODES + 1))] = ""
    use: tuple[bool, bool, bool] = (True, True, True)
    mode: Literal["plain", "tint", "ghost", "isolate"] = "plain"
    ramp: Annotated[str, Field(max_length=1024)] = ""
    text: str = ""
    level: LevelName = "auto"
    marked: Bits = ""


def rows_of(text: str, width: int, count: int) -> UInt8[np.ndarray, "count width"]:
    """Return the rows of bytes in a text of base64; an empty text gives zeros."""
    if not text:
        return np.zeros((count, width), np.uint8)
    try:
        return np.frombuffer(base64.b64decode(text, validate=True), np.uint8).reshape(count, width)
    except ValueError as error:
        raise SettingsError(
            "the colours or marks do not fit the scene",
            expected=f"base64 of {count} rows of {width} bytes",
            found=str(error),
            fix="reload the page",
        ) from error


class Asked(Message):
    """Base class of requests about one variant of the scene."""

    variant: Annotated[str, Field(max_length=100)] = "default"


class Edited(Asked):
    """Base class of requests about the scene without the Gaussians that the user has removed."""

    removed: Bits = ""


class Question(Message):
    """A text or a path, optionally with a minimum score or restricted to the nodes that a view shows."""

    text: str
    level: LevelName = "auto"
    threshold: Annotated[float, Field(gt=0, lt=1)] | None = None
    view: Annotated[int, Field(ge=0)] | None = None


class Query(Asked, Question):
    """A query of a variant's tree or field."""

    answerer: Answerer = "tree"


class Like(Asked):
    """A search for nodes that look like a given node or picture (base64 of an image file)."""

    node: Annotated[int, Field(ge=0)] | None = None
    picture: Annotated[str, Field(max_length=900_000)] = ""


class FieldRelevancy(Asked):
    """A query for each Gaussian's field relevancy, in the order of the PLY file or of the page's chunks."""

    text: str
    level: LevelName = "auto"
    order: Literal["file", "page"] = "file"


class Pick(Edited):
    """A pixel of the page's picture in a style, which may hide Gaussians."""

    camera: WireCamera
    x: float
    y: float
    style: Style = Style()


class Members(Asked):
    """Nodes whose Gaussians are selected, or, with `loose`, the Gaussians that belong to no node."""

    nodes: Nodes = Field(default_factory=list)
    loose: bool = False


class Region(Asked):
    """A region of the page's picture: a rectangle with two opposite corners, or a stroke of a round brush.

    Attributes:
        points: the corners, or the vertices of the stroke, px.
        radius: radius of the brush, px; 0 for a rectangle.
        style: style of the picture; Gaussians that it hides are not selected.
    """

    camera: WireCamera
    points: Annotated[tuple[tuple[Place, Place], ...], Field(min_length=1, max_length=10_000)]
    radius: Annotated[float, Field(ge=0, le=MAX_SIDE_PX)] = 0.0
    style: Style = Style()


class Frame(Edited):
    """A picture rendered by the server."""

    camera: WireCamera
    style: Style = Style()
    quality: Annotated[int, Field(ge=20, le=100)] = 80
    image: Literal["jpeg", "png"] = "jpeg"

    @field_validator("camera")
    @classmethod
    def _can_be_rendered(cls, camera: WireCamera) -> WireCamera:
        if max(camera.size_hw) > MAX_SIDE_PX:
            raise ValueError(f"a picture has sides of at most {MAX_SIDE_PX} px")
        return camera


class Film(Edited):
    """A film along a tour of the training cameras, or along a path of cameras."""

    style: Style = Style()
    format: Literal["mp4", "gif"] = "mp4"
    side_px: Annotated[int, Field(ge=64, le=1920)] = 640
    frames: Annotated[int, Field(ge=2, le=480)] = 120
    path: Annotated[tuple[WireCamera, ...], Field(max_length=40)] = ()


class Group(Message):
    """Named nodes: the answers to a query, with their scores and doubts, or a selection (`NodeGroup`)."""

    name: Annotated[str, Field(max_length=MAX_TEXT)]
    nodes: Nodes
    scores: Annotated[tuple[float, ...], Field(max_length=MAX_NODES)] = ()
    doubts: Annotated[tuple[Annotated[str, Field(max_length=1000)], ...], Field(max_length=10)] = ()

    @model_validator(mode="after")
    def _a_score_for_each_node(self) -> "Group":
        if self.scores and len(self.scores) != len(self.nodes):
            raise ValueError("the number of scores differs from the number of nodes")
        return self

    def group(self) -> NodeGroup:
        """Return the group as the package's type."""
        return NodeGroup(self.name, tuple(self.nodes), self.scores, self.doubts)


class Selection(Edited):
    """Groups of nodes, which may overlap."""

    groups: Annotated[list[Group], Field(min_length=1, max_length=40)]


class Names(Asked):
    """The names of a tree's nodes, which replace all previous names."""

    names: dict[int, Annotated[str, Field(max_length=200)]]


class Page(Edited):
    """A page as one HTML file, with the answers to some queries."""

    asked: Annotated[tuple[Question, ...], Field(max_length=40)] = ()
    answerer: Answerer = "tree"
    link: Annotated[str, Field(max_length=100_000)] = ""
    """Part after # of the address that the page opens with; empty for the first photograph's camera."""
