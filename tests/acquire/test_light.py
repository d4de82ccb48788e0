"""Light kept constant by a reference patch: slowly, within limits, and a lamp that fails is told in time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspector.acquire import light
from inspector.acquire.light import LightSettings, Patch, Trim
from inspector.faults import Fault

PATCH = Patch(x_px=2, y_px=1, width_px=3, height_px=2)
SETTINGS = LightSettings(patch=PATCH, target_dn=100.0)
LEVEL_PERCENT = 80.0
FRAME_S = 5.0


def run(bulb: Any, minutes: float) -> list[tuple[float, Trim, Fault]]:
    """Patch means, trims and faults of a lamp whose light is ``bulb(minutes)`` of what it was, frame by frame."""
    trim, seen = Trim(), []
    for step in range(int(minutes * 60 / FRAME_S)):
        now_s = step * FRAME_S
        level = LEVEL_PERCENT + trim.percent
        mean_dn = 100.0 * level / LEVEL_PERCENT * bulb(now_s / 60)
        fault = light.fault_of_light(mean_dn, SETTINGS.target_dn, SETTINGS.tolerance)
        trim = light.trimmed(trim, mean_dn, SETTINGS.target_dn, level, SETTINGS, now_s)
        seen.append((mean_dn, trim, fault))
    return seen


def test_the_patch_is_a_rectangle_of_the_image_and_must_be_all_there() -> None:
    image = np.arange(40, dtype=np.uint8).reshape(5, 8)
    assert light.patch_mean_dn(image, PATCH) == image[1:3, 2:5].mean()
    wide = Patch(x_px=0, y_px=0, width_px=8, height_px=4)
    assert light.patch_mean_dn(image, wide) == image[1:3, 2:6].mean()
    assert math.isnan(light.patch_mean_dn(image, PATCH.model_copy(update={"x_px": 6})))


def test_the_reference_is_not_inspected() -> None:
    image = np.full((64, 64), 9, np.uint8)
    image[1:3, 2:5] = 200
    assert np.array_equal(light.without(image, PATCH), np.full((64, 64), 9))
    assert image.max() == 200


def test_an_ageing_bulb_is_made_up_for_within_a_percent_and_called_weak_well_before_it_is_refused() -> None:
    seen = run(lambda minutes: 1 - 0.001 * minutes, minutes=300)
    weak = next(n for n, (_, trim, _) in enumerate(seen) if light.is_weak(trim, SETTINGS))
    refused = next(n for n, (_, _, fault) in enumerate(seen) if fault)
    limit = next(n for n, (_, trim, _) in enumerate(seen) if trim.percent == SETTINGS.trim_limit_percent)
    assert weak < limit < refused
    assert (refused - weak) * FRAME_S > 3600
    assert all(abs(mean_dn - 100) < 1.0 for mean_dn, _, _ in seen[:limit])
    assert seen[refused][2] is Fault.LAMP_WEAK


def test_a_sudden_loss_is_refused_and_trimmed_slowly() -> None:
    seen = run(lambda minutes: 1.0 if minutes < 1 else 0.5, minutes=30)
    first = next(n for n, (_, _, fault) in enumerate(seen) if fault)
    assert first == int(60 / FRAME_S)
    trims = [trim.percent for _, trim, _ in seen]
    assert max(np.diff(trims)) <= SETTINGS.trim_percent_per_minute * FRAME_S / 60 + 1e-9
    assert trims[-1] == SETTINGS.trim_limit_percent


def test_a_dead_bulb_is_refused_at_once_and_other_light_too() -> None:
    assert light.fault_of_light(0.0, 100.0, 0.15) is Fault.LAMP_WEAK
    assert light.fault_of_light(math.nan, 100.0, 0.15) is Fault.LAMP_WEAK
    assert light.fault_of_light(130.0, 100.0, 0.15) is Fault.FRAME_OVERLIT
    assert light.fault_of_light(114.0, 100.0, 0.15) is Fault.NONE


def test_after_a_stop_the_level_does_not_jump() -> None:
    after = light.trimmed(Trim(1.0, 0.0), 90.0, 100.0, 80.0, SETTINGS, 1e6)
    assert after == Trim(1.0 + SETTINGS.trim_percent_per_minute, 1e6)


@given(st.lists(st.floats(0, 300) | st.just(math.nan)), st.floats(0, 100))
def test_whatever_is_measured_the_trim_stays_within_its_limits(means_dn: list[float], level_percent: float) -> None:
    trim = Trim()
    for n, mean_dn in enumerate(means_dn):
        trim = light.trimmed(trim, mean_dn, 100.0, level_percent, SETTINGS, 30.0 * n)
        assert abs(trim.percent) <= SETTINGS.trim_limit_percent


@pytest.mark.parametrize("mean_dn", [99.9, 100.1])
def test_next_to_its_target_nothing_moves(mean_dn: float) -> None:
    assert light.trimmed(Trim(2.0, 0.0), mean_dn, 100.0, 80.0, SETTINGS, 60.0).percent == 2.0
