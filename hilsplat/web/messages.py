"""Base class of both pages' request models, and limits shared by these models."""

from pydantic import BaseModel, ConfigDict

MAX_SIDE_PX = 4096


class Message(BaseModel):
    """Base class of all request models; unknown keys, NaN and infinity are rejected."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)
