"""Base class of both pages' request models, and limits shared by these models."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

MAX_SIDE_PX = 4096
Text = Annotated[str, Field(min_length=1, max_length=200)]


class Message(BaseModel):
    """Base class of all request models; unknown keys, NaN and infinity are rejected."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)
