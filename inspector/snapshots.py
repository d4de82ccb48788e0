"""What the registers show next, from what they showed last. Pure: the time comes from the caller.

Every cycle ends in one result, and each result's sequence is one more than the last one's, whether the frame was
inspected or there was none. A result that is NOT_INSPECTED shows nothing of the result before it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from inspector.acquire.device_faults import FAULTS
from inspector.faults import Fault
from inspector.lifecycle import Event, after
from inspector.model import Frame, FrameResult, PanelResult, Reason, Snapshot, State, Verdict

FRAME_FAULTS = {
    Reason.FRAME_UNREADABLE: Fault.CAMERA_FRAME_WRONG,
    Reason.FRAME_WRONG_SHAPE: Fault.FRAME_WRONG_SHAPE,
    Reason.FRAME_BLACK: Fault.FRAME_BLACK,
    Reason.FRAME_OVERLIT: Fault.FRAME_OVERLIT,
    Reason.TOO_MANY_HIGHLIGHTS: Fault.FRAME_OVERLIT,
}
"""Why a frame could not be judged -> the fault code shown with it."""

FAULT_REASONS = {
    Fault.LAMP_READBACK: Reason.LAMP_NOT_AS_SET,
    Fault.LAMP_WARMING_UP: Reason.LAMP_NOT_AS_SET,
    Fault.LAMP_WEAK: Reason.LAMP_NOT_AS_SET,
    Fault.FRAME_OVERLIT: Reason.FRAME_OVERLIT,
    Fault.EXPOSURE_READBACK: Reason.EXPOSURE_NOT_AS_SET,
}
"""Reason bits of a cycle without a frame; DEVICE_FAULT where the code is not listed."""


SEEN_WAITING = {Fault.NONE, Fault.LAMP_WARMING_UP} | {code for codes in FAULTS.values() for code in codes.values()}
"""Faults whose end can be seen without a frame."""


@dataclass(frozen=True, slots=True)
class Times:
    """When a result is published (monotonic seconds), how long inspection and whole cycle took (microseconds)."""

    now_s: float
    elapsed_us: float
    cycle_us: float


def inspected(last: Snapshot, frame: Frame, result: FrameResult, times: Times) -> Snapshot:
    """A frame was taken as asked, and this is what it says, which may be that it cannot be judged."""
    reason = next((reason for reason in FRAME_FAULTS if reason in result.reasons), None)
    unjudged = result.verdict is Verdict.NOT_INSPECTED
    shown = replace(
        last,
        state=after(last.state, Event.RECOVERED, Event.PREPARED, Event.STARTED_CONTINUOUS),
        fault_code=FRAME_FAULTS[reason] if reason and unjudged else Fault.NONE,
        acquisition_id=frame.frame_id,
        reasons=result.reasons,
        defects=result.defects,
        unpaired_count=len(result.unpaired),
        elapsed_us=times.elapsed_us,
        lamp_read_v=frame.lamp_v or 0.0,
        exposure_us=frame.exposure_us or 0.0,
        lamp_ok=True,
        camera_ok=True,
    )
    return _counted(shown, result.verdict, times)


def taken(last: Snapshot, frame: Frame, result: FrameResult | None = None) -> Snapshot:
    """A frame of a panel that is not done, or (``result`` None) of none: the station as it is, with its last result.

    A frame that cannot be judged is a fault, and takes back the last verdict as any fault does.
    """
    shown = replace(
        last,
        state=after(last.state, Event.RECOVERED, Event.PREPARED, Event.STARTED_CONTINUOUS),
        fault_code=Fault.NONE,
        acquisition_id=frame.frame_id,
        lamp_read_v=frame.lamp_v or 0.0,
        exposure_us=frame.exposure_us or 0.0,
        lamp_ok=True,
        camera_ok=True,
    )
    if result is None or result.verdict is not Verdict.NOT_INSPECTED:
        return shown
    reason = next((reason for reason in FRAME_FAULTS if reason in result.reasons), None)
    fault_code = FRAME_FAULTS[reason] if reason else Fault.NONE
    shown = replace(shown, fault_code=fault_code, reasons=result.reasons, defects=(), unpaired_count=0)
    return replace(shown, verdict=Verdict.NOT_INSPECTED)


def of_panel(last: Snapshot, panel: PanelResult, now_s: float) -> Snapshot:
    """A panel of several frames is done; what the station shows of its last frame stays."""
    shown = replace(
        last,
        reasons=panel.reasons,
        defects=panel.defects,
        unpaired_count=len(panel.unpaired),
        panel_frames=len(panel.travels_mm),
        extent=panel.extent,
        elapsed_us=panel.elapsed_us,
    )
    counted = _counted(shown, panel.verdict, Times(now_s, panel.elapsed_us, last.cycle_us))
    return replace(counted, panel_id=counted.panel_id if panel.panel_id is None else panel.panel_id)


def not_inspected(last: Snapshot, fault: Fault, times: Times) -> Snapshot:
    """A cycle ended without a frame that may be inspected, because of ``fault``."""
    # A lamp that warms up is no error: the station is not ready yet.
    events = (Event.FAULT, Event.RECOVERED) if fault is Fault.LAMP_WARMING_UP else (Event.FAULT,)
    shown = replace(
        last,
        state=after(last.state, *events),
        fault_code=fault,
        reasons=_reasons(fault),
    )
    return _counted(_nothing_seen(shown), Verdict.NOT_INSPECTED, times)


def waiting(last: Snapshot, fault: Fault) -> Snapshot:
    """The station waits for its trigger: ready, or not because of ``fault``. That is no result: a fault takes back the
    last verdict, which nobody stands behind any more, and its end does not bring it back."""
    if fault:
        events = (Event.FAULT, Event.RECOVERED) if fault is Fault.LAMP_WARMING_UP else (Event.FAULT,)
        shown = replace(last, state=after(last.state, *events), fault_code=fault, reasons=_reasons(fault))
        return replace(_nothing_seen(shown), verdict=Verdict.NOT_INSPECTED)
    if last.fault_code not in SEEN_WAITING:
        return last
    return replace(last, state=after(last.state, Event.RECOVERED, Event.PREPARED), fault_code=Fault.NONE)


def can_inspect(shown: Snapshot) -> bool:
    """Whether a trigger would be taken: ready, or in a fault whose end only a frame can show."""
    return shown.state is State.READY or (shown.state is State.ERROR and shown.fault_code not in SEEN_WAITING)


def cleared(last: Snapshot) -> Snapshot:
    """Somebody has seen the fault: one whose end only a frame can show is forgotten, others last as long as they do."""
    seen = replace(last, settings_refused=False)
    if last.fault_code in SEEN_WAITING:
        return seen
    return replace(seen, state=after(last.state, Event.RECOVERED, Event.PREPARED), fault_code=Fault.NONE)


def taken_back(last: Snapshot) -> Snapshot:
    """The station goes on by other settings: the last result is not theirs, and nobody stands behind it any more. One
    that was NOT_INSPECTED stays, with its reasons."""
    shown = replace(_nothing_seen(last), panel_frames=1, extent=None)
    if last.verdict is Verdict.NOT_INSPECTED:
        return shown
    return replace(shown, verdict=Verdict.NOT_INSPECTED, reasons=Reason(0))


def stopped(last: Snapshot) -> Snapshot:
    """The service is going off: nobody stands behind the last verdict any more."""
    return replace(
        last,
        state=after(last.state, Event.HALTED),
        verdict=Verdict.NOT_INSPECTED,
        reasons=Reason(0),
        defects=(),
        unpaired_count=0,
        frames_so_far=0,
        statistics=None,
        lamp_read_v=0.0,
        lamp_ok=False,
        camera_ok=False,
    )


def _reasons(fault: Fault) -> Reason:
    return FAULT_REASONS.get(fault, Reason.DEVICE_FAULT)


def _nothing_seen(shown: Snapshot) -> Snapshot:
    """The snapshot without anything of a frame."""
    return replace(shown, defects=(), unpaired_count=0, elapsed_us=0.0, lamp_read_v=0.0, exposure_us=0.0)


def _counted(shown: Snapshot, verdict: Verdict, times: Times) -> Snapshot:
    """The snapshot as a result of its own: verdict, next sequence, count, times."""
    return replace(
        shown,
        verdict=verdict,
        sequence=shown.sequence + 1,
        panel_id=shown.panel_id + 1,
        panels_passed=shown.panels_passed + (verdict is Verdict.PASS),
        panels_failed=shown.panels_failed + (verdict is Verdict.FAIL),
        panels_not_inspected=shown.panels_not_inspected + (verdict is Verdict.NOT_INSPECTED),
        result_at_s=times.now_s,
        cycle_us=times.cycle_us,
    )
