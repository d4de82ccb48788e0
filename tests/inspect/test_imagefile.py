"""Frames come out of files bit for bit, or the file is refused with its name, its problem and the remedy."""

from __future__ import annotations

import os
import pickle
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from inspector.imagefile import FrameUnreadable, read
from inspector.model import Image

RANDOM = np.random.default_rng(4)
GREY8 = RANDOM.integers(0, 256, (48, 64), np.uint8)
GREY16 = RANDOM.integers(0, 65536, (48, 64), np.uint16)


def saved(path: Path, image: Image) -> Path:
    if path.suffix == ".npy":
        np.save(path, image)
    else:
        assert cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize(
    ("suffix", "image"),
    [(s, GREY8) for s in ("png", "tif", "bmp", "pgm", "npy")] + [(s, GREY16) for s in ("png", "tif", "pgm", "npy")],
)
def test_reads_back_bit_for_bit(tmp_path: Path, suffix: str, image: Image) -> None:
    got = read(saved(tmp_path / f"frame.{suffix}", image))
    assert got.dtype == image.dtype
    assert np.array_equal(got, image)


def test_the_content_tells_the_kind_not_the_name(tmp_path: Path) -> None:
    assert np.array_equal(read(saved(tmp_path / "a.png", GREY8).rename(tmp_path / "a.raw")), GREY8)


def test_a_12_bit_frame_keeps_its_grey_values(tmp_path: Path) -> None:
    frame = GREY16 // 16
    (tmp_path / "binary.pgm").write_bytes(b"P5\n# line camera\n64 48\n4095\n" + frame.astype(">u2").tobytes())
    (tmp_path / "ascii.pgm").write_text("P2\n64 48\n4095\n" + " ".join(map(str, frame.ravel())))
    assert np.array_equal(read(tmp_path / "binary.pgm"), frame)
    assert np.array_equal(read(tmp_path / "ascii.pgm"), frame)


@pytest.mark.parametrize("stored", [GREY16.astype(">u2"), np.asfortranarray(GREY16)], ids=["big-endian", "fortran"])
def test_numpy_arrays_of_any_layout_come_out_native_and_contiguous(tmp_path: Path, stored: Image) -> None:
    got = read(saved(tmp_path / "a.npy", stored))
    assert got.dtype == np.dtype(np.uint16)
    assert got.flags.c_contiguous
    assert np.array_equal(got, GREY16)


def refusal(path: Path) -> str:
    with pytest.raises(FrameUnreadable) as refused:
        read(path)
    message = str(refused.value)
    assert message.startswith(f"{path}: ")
    assert "; " in message, "a refusal ends with its remedy"
    return message


@pytest.mark.parametrize(
    ("suffix", "channels"),
    [(s, 3) for s in ("png", "tif", "bmp", "ppm", "npy")] + [(s, 4) for s in ("png", "tif", "bmp", "npy")],
)
def test_a_colour_image_is_refused_as_such_even_if_its_channels_are_equal(
    tmp_path: Path, suffix: str, channels: int
) -> None:
    path = saved(tmp_path / f"a.{suffix}", np.dstack([GREY8] * channels))
    assert "colour" in refusal(path)


@pytest.mark.parametrize("name", ["a.png", "b.png", "a.tif", "a.bmp", "a.pgm", "a.npy"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.97, 0.999])
def test_a_file_cut_short_is_refused_quietly(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, share: float
) -> None:
    path = saved(tmp_path / name, GREY16 if name == "b.png" else GREY8)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert "cut short" in refusal(path) or share < 0.1
    assert capfd.readouterr() == ("", "")


def test_a_png_with_one_bit_flipped_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.png", GREY8)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert "damaged" in refusal(path)


def test_a_tiff_of_several_pages_is_refused(tmp_path: Path) -> None:
    assert cv2.imwritemulti(str(tmp_path / "a.tif"), [GREY8, GREY8])
    assert "2 pages" in refusal(tmp_path / "a.tif")


class Bomb:
    def __reduce__(self) -> tuple[Callable[[str], object], tuple[str]]:
        return os.mkdir, ("exploded",)


def test_a_pickle_is_never_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("object.npy", np.array([[Bomb()]], dtype=object), allow_pickle=True)
    Path("pickle.npy").write_bytes(pickle.dumps(Bomb()))
    assert "no plain numbers" in refusal(Path("object.npy"))
    refusal(Path("pickle.npy"))
    assert not Path("exploded").exists()


def test_a_numpy_file_that_claims_more_than_it_holds_takes_no_memory(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.npy", GREY8)
    path.write_bytes(path.read_bytes().replace(b"(48, 64), ", b"(48000000000, 64), ".ljust(10))[:200])
    refusal(path)


@pytest.mark.parametrize(
    "content",
    [
        np.zeros((4, 4), np.float32),
        np.zeros((4, 4), np.int16),
        np.zeros((4, 4), np.uint32),
        np.zeros((4, 4), np.bool_),
        np.zeros(16, np.uint8),
        np.zeros((2, 2, 2, 2), np.uint8),
        np.zeros((0, 4), np.uint8),
        np.uint8(1),
    ],
    ids=lambda a: f"{a.dtype}{a.shape}",
)
def test_arrays_that_are_no_grey_frame_are_refused(tmp_path: Path, content: Image) -> None:
    refusal(saved(tmp_path / "a.npy", content))


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    assert "folder" in refusal(tmp_path)
    assert "no such file" in refusal(tmp_path / "missing.png")
    assert "ordinary file" in refusal(Path(os.devnull))
    (tmp_path / "empty.png").touch()
    assert "empty" in refusal(tmp_path / "empty.png")
    (tmp_path / "text.png").write_text("a frame")
    assert "PNG, TIFF, BMP, PGM or .npy" in refusal(tmp_path / "text.png")


def test_a_whole_png_with_spoilt_pixels_is_refused(tmp_path: Path) -> None:
    """Checksums right, content cut: the compressed stream is replaced by the half of it."""
    path = saved(tmp_path / "a.png", GREY8)
    data = path.read_bytes()
    start = data.index(b"IDAT")
    length = int.from_bytes(data[start - 4 : start], "big")
    half = data[start : start + 4 + length // 2]
    chunk = (len(half) - 4).to_bytes(4, "big") + half + zlib.crc32(half).to_bytes(4, "big")
    path.write_bytes(data[: start - 4] + chunk + data[-12:])
    assert "damaged" in refusal(path)
