"""The bill of materials of a small tree, and what an audit says of what it was told."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"
BILL = "import sys, pathlib, sbom; print(sbom.bill(pathlib.Path(sys.argv[1]), 'program'))"
MENDED = {"id": "CVE-2026-1", "fix_versions": ["1.1"]}


def distribution(site: Path, name: str, licence: str, *files: str) -> None:
    """An installed distribution, as far as its record goes."""
    folder = site / f"{name}-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(f"Metadata-Version: 2.4\nName: {name}\nVersion: 1.0\n{licence}\n")
    (folder / "RECORD").write_text("".join(f"{file},,\n" for file in files))


def bill(site: Path) -> Any:
    done = subprocess.run([sys.executable, "-c", BILL, site], cwd=DEPLOY, capture_output=True, timeout=60, check=True)
    return json.loads(done.stdout)


def test_the_bill_lists_distributions_by_name_and_the_native_libraries_that_they_bring(tmp_path: Path) -> None:
    library = tmp_path / "Some_Part.libs/libz.so.1"
    library.parent.mkdir()
    library.write_bytes(b"native")
    distribution(tmp_path, "Some_Part", "License-Expression: MIT AND Zlib", "some_part.py", "Some_Part.libs/libz.so.1")
    distribution(tmp_path, "other", "Classifier: License :: OSI Approved :: BSD License")
    distribution(tmp_path, "program", "")
    said = bill(tmp_path)
    assert said["metadata"]["component"]["purl"] == "pkg:pypi/program@1.0"
    other, part = said["components"]
    assert (other["purl"], other["licenses"]) == ("pkg:pypi/other@1.0", [{"license": {"name": "BSD License"}}])
    assert (part["purl"], part["licenses"]) == ("pkg:pypi/some-part@1.0", [{"expression": "MIT AND Zlib"}])
    (native,) = part["components"]
    assert native["name"] == "libz.so.1"
    assert native["hashes"] == [{"alg": "SHA-256", "content": hashlib.sha256(b"native").hexdigest()}]
    assert bill(tmp_path) == said


@pytest.mark.parametrize(
    ("parts", "status", "words"),
    [
        ([{"name": "a", "version": "1.0", "vulns": []}], 0, "1 of 1 dependencies audited, 0 advisories"),
        ([{"name": "a", "version": "1.0", "vulns": [MENDED]}], 1, "a 1.0: CVE-2026-1, mended in 1.1"),
        ([{"name": "a", "skip_reason": "not found"}], 0, "NOT AUDITED, their advisories are out of reach: a"),
        (None, 0, "NOT AUDITED"),
    ],
)
def test_an_audit_fails_by_what_is_known_and_says_what_it_could_not_ask(parts: Any, status: int, words: str) -> None:
    told = "" if parts is None else json.dumps({"dependencies": parts})
    audit = [sys.executable, DEPLOY / "audit.py"]
    done = subprocess.run(audit, input=told, capture_output=True, text=True, timeout=60)
    assert done.returncode == status
    assert words in done.stdout
