"""How panels are made of frames must fit module, trigger and camera. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from inspector.panel_settings import ByInput, Encoder, LineSpeed, PanelSettings

if TYPE_CHECKING:
    from inspector.optics import Camera

Misfit = tuple[tuple[str, ...], object, str]
"""Place in the settings, value, and what is allowed."""


def misfits(
    panel: PanelSettings, inputs: int, trigger_channel: int | None, by_camera_line: bool, camera: Camera | None
) -> Iterator[Misfit]:
    """What does not fit: ``inputs`` of the module, the one that triggers cycles (None: none does), whether the camera's
    own line does, and the ``camera`` (None: not known)."""
    if not panel.several:
        return
    if panel.travel is None:
        yield ("panel", "travel"), None, "required where a panel has several frames; allowed: how it moves between them"
    if isinstance(panel.frames, ByInput):
        yield from _input_misfits(panel.frames, inputs, trigger_channel)
    if panel.travel and isinstance(panel.travel.by, Encoder) and not by_camera_line:
        what = "an encoder triggers the camera itself; allowed with it: cycle.trigger hardware_line"
        yield ("panel", "travel", "by"), "encoder", what
    if camera is not None:
        yield from _travel_misfits(panel, camera)


def _input_misfits(frames: ByInput, inputs: int, trigger_channel: int | None) -> Iterator[Misfit]:
    place = ("panel", "frames", "channel")
    if frames.channel >= inputs:
        allowed = f"0 to {inputs - 1}" if inputs else "none: choose another module, or frames by something else"
        yield place, frames.channel, f"the module has {inputs} digital inputs; allowed: {allowed}"
    elif frames.channel == trigger_channel:
        yield place, frames.channel, "is cycle.trigger's, which says when a frame is taken; allowed: one of its own"


def _travel_misfits(panel: PanelSettings, camera: Camera) -> Iterator[Misfit]:
    """The panel may move no further between two frames than a frame sees."""
    if panel.travel is None:
        return
    from inspector.judge.coverage import View  # only stations with panels of several frames pay for it

    view = View.of(camera, panel.travel.direction)
    if view is None:
        what = "the frame is not all on the panel, so what is seen of it is not known; allowed: a steeper camera"
        yield ("panel", "frames"), panel.frames.kind, what
    elif not isinstance(panel.travel.by, LineSpeed) and panel.travel.by.mm_per_frame > view.length_mm:
        what = f"leaves gaps between frames; allowed: up to {view.length_mm:.1f} mm"
        yield ("panel", "travel", "by"), panel.travel.by.mm_per_frame, what
