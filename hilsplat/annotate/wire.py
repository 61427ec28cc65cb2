"""Request models of the annotation page: strokes, shapes, pixels, labels."""

from typing import Annotated

from pydantic import Field

from hilsplat.annotate.labels import Label, Place, Rings
from hilsplat.web.messages import Message


class Stroke(Message):
    """A brush stroke: discs of one radius along points, px."""

    points: Annotated[list[tuple[Place, Place]], Field(min_length=1, max_length=20_000)]
    radius: Annotated[float, Field(ge=0.5, le=500)]
    erase: bool = False


class Shape(Message):
    """A region composed of polygons and a stroke, inside its parent."""

    view: int
    add: Rings
    stroke: Stroke | None = None
    inside: Rings | None = None


class At(Message):
    """A pixel of a photograph."""

    view: int
    x: int
    y: int


class Segment(Message):
    """Clicks on one thing in a photograph (x, y, inside), or a box around it (left, top, right, bottom)."""

    view: int
    clicks: Annotated[tuple[tuple[int, int, bool], ...], Field(max_length=64)] = ()
    box: tuple[int, int, int, int] | None = None


class Carry(Message):
    """Ids of things, and the view to transfer them to."""

    ids: Annotated[list[int], Field(min_length=1, max_length=2000)]
    view: int


class Labels(Message):
    """All annotations of a view."""

    labels: Annotated[list[Label], Field(max_length=2000)]


class File(Message):
    """A file of annotations."""

    name: Annotated[str, Field(max_length=300)]
    text: str


class Given(Message):
    """Files of annotations."""

    files: Annotated[list[File], Field(min_length=1, max_length=5000)]
