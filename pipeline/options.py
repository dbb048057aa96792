"""Base of every options record, and the per-instrument settings that travel with an image."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Options(BaseModel):
    """Frozen options, closed to unknown keys; each stage declares its own subclass beside its code."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class InstrumentSettings(Options):
    """Image-side settings of a camera, with the archive's or the sidecar's values on top (seed 000)."""

    fit_camera_rotation: bool = Field(False, description="fit an in-plane rotation beside the translation")
    max_rotation_deg: float = Field(5.0, ge=0, le=45, description="bound on the rotation's magnitude, degrees")
    search_margin_vu: tuple[Annotated[float, Field(ge=1, le=2000)], Annotated[float, Field(ge=1, le=2000)]] = Field(
        (50.0, 50.0), description="largest offset searched for along v and u, pixels"
    )

    @model_validator(mode="after")
    def _rotation_needs_room(self) -> "InstrumentSettings":
        if self.fit_camera_rotation and self.max_rotation_deg == 0.0:
            raise ValueError("fit_camera_rotation needs a max_rotation_deg above 0")
        return self
