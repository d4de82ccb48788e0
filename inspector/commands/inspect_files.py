"""Frames from files, one after the other, through the main path; what cannot be inspected is said, the rest go on."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from inspector import calibration_file, imagefile, pipeline, result_text
from inspector.change_options import Unusable, recipe_of
from inspector.model import Frame, FrameResult, Image, Reason, Verdict
from inspector.pipeline import Station
from inspector.recipe import Recipe

ALL_INSPECTED, SOME_NOT_INSPECTED, NOTHING_DONE = 0, 1, 2
"""Exit statuses."""


def run(
    frames: Sequence[str],
    calibration: Path,
    recipe: Path | None = None,
    method: str | None = None,
    output_format: str = "jsonl",
    overlay: Path | None = None,
) -> int:
    """Inspect each frame and print its result at once; return the exit status. ``method`` overrules the recipe's."""
    try:
        station = _station(calibration, recipe, method)
        pictures = None if overlay is None else Pictures(overlay)
    except Unusable as error:
        print(f"inspector: {error}", file=sys.stderr)
        return NOTHING_DONE
    not_inspected = 0

    def results() -> Iterator[FrameResult]:
        nonlocal not_inspected
        for name in frames:
            image, result = inspect_file(name, station)
            if result.verdict is Verdict.NOT_INSPECTED:
                not_inspected += 1
                print(f"inspector: {name}: {' '.join(result.reasons_text)}", file=sys.stderr, flush=True)
            if pictures is not None and image is not None:
                pictures.save(image, result)
            yield result

    for line in result_text.FORMATS[output_format](results()):
        print(line, flush=True)
    return SOME_NOT_INSPECTED if not_inspected else ALL_INSPECTED


def inspect_file(name: str, station: Station) -> tuple[Image | None, FrameResult]:
    """The frame in a file (None if it cannot be read) and its result, timed from frame in memory to verdict."""
    try:
        image = imagefile.read(Path(name))
    except imagefile.FrameUnreadable as error:
        return None, FrameResult(name, Verdict.NOT_INSPECTED, Reason.FRAME_UNREADABLE, (error.sentence,))
    start = time.perf_counter()
    try:
        result = pipeline.inspect(Frame(image, name), station)
    except Exception as error:  # One frame that trips the program must not cost the others their verdicts.
        traceback.print_exc()
        text = f"an error in the program ({type(error).__name__}: {error}); send us the frame and this output"
        result = FrameResult(name, Verdict.NOT_INSPECTED, reasons_text=(text,))
    return image, replace(result, elapsed_us=1e6 * (time.perf_counter() - start))


class Pictures:
    """Overlays in a folder, each under its frame's name; a name that comes twice in a run is numbered."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._taken: set[str] = set()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Unusable(f"--overlay {folder}: cannot be made a folder ({error.strerror})") from error

    def save(self, image: Image, result: FrameResult) -> None:
        """Draw the result and write it; a disk that refuses is said, the inspection goes on."""
        import cv2

        from inspector import overlay

        path = self._folder / self._name(Path(result.frame).stem)
        try:
            path.write_bytes(cv2.imencode(".png", overlay.draw(image, result))[1].tobytes())
        except OSError as error:
            print(f"inspector: {path}: overlay not written ({error.strerror})", file=sys.stderr)

    def _name(self, stem: str) -> str:
        name, number = f"{stem}.png", 1
        while name in self._taken:
            number += 1
            name = f"{stem}-{number}.png"
        self._taken.add(name)
        return name


def _station(calibration: Path, recipe: Path | None, method: str | None) -> Station:
    try:
        station = Station(calibration_file.read(calibration), recipe_of(recipe) if recipe else Recipe())
    except calibration_file.CalibrationError as error:
        raise Unusable(str(error)) from error
    if method is None:
        return station
    return replace(station, recipe=station.recipe.model_copy(update={"method": method}))
