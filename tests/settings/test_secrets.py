"""Secrets that systemd hands over, and files that others may read or write."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from inspector import credential
from inspector.publish.plc_settings import TlsSettings
from inspector.service.permissions import misfits
from inspector.settings import SettingsError, load

CONFIG = Path(__file__).parents[2] / "config"


def tls(key: str) -> TlsSettings:
    return TlsSettings.model_validate({"certificate": "a.pem", "key": key, "client_ca": "b.pem"})


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A settings file, its calibration and a key, all kept from others."""
    shutil.copytree(CONFIG, tmp_path / "etc")
    for path in (tmp_path / "etc").rglob("*"):
        path.chmod(0o755 if path.is_dir() else 0o644)
    (tmp_path / "etc/plc.key").touch(0o600)
    (tmp_path / "state").mkdir(0o700)
    return tmp_path / "etc/demo.yaml"


def with_tls(file: Path, key: str) -> Path:
    """The settings file with this key; in the place of certificates is a file that can be read."""
    settings = yaml.safe_load(file.read_text())
    settings["plc"]["tls"] = {"certificate": file.name, "key": key, "client_ca": file.name}
    file.write_text(yaml.safe_dump(settings))
    return file


def test_a_credential_is_the_file_that_systemd_handed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "plc.key").write_text("secret")
    monkeypatch.setenv(credential.FOLDER, str(tmp_path))
    found = tls("credential:plc.key").under(Path("/etc/inspector"))
    assert found.key == tmp_path / "plc.key"
    assert credential.is_credential(found.key)
    assert found.certificate == Path("/etc/inspector/a.pem")
    assert not credential.is_credential(found.certificate)


@pytest.mark.parametrize(
    ("name", "folder", "said"),
    [
        ("plc.key", None, "LoadCredential=plc.key and the file /etc/credstore/plc.key"),
        ("other.key", "here", "No such file or directory; allowed: a unit with LoadCredential=other.key"),
        ("../etc/shadow", "here", "without a folder"),
        ("", "here", "without a folder"),
    ],
)
def test_a_credential_that_is_not_there_is_refused_with_the_remedy(
    name: str, folder: str | None, said: str, copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(credential.FOLDER, raising=False)
    if folder:
        monkeypatch.setenv(credential.FOLDER, str(copied.parent))
    with pytest.raises(SettingsError, match=rf"plc\.tls\.key: .*{said}"):
        load(with_tls(copied, f"credential:{name}"))


@pytest.mark.parametrize("key", ["credential:plc.key", "not-there.key"])
def test_who_only_reads_the_settings_needs_no_secret_of_the_services(
    key: str, copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(credential.FOLDER, raising=False)
    assert load(with_tls(copied, key), secrets=False).plc.tls is not None
    with pytest.raises(SettingsError, match="without a folder"):
        load(with_tls(copied, "credential:a/b"), secrets=False)


def test_outside_of_a_service_it_is_the_file_that_systemd_would_hand_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "plc.key").write_text("secret")
    monkeypatch.delenv(credential.FOLDER, raising=False)
    monkeypatch.setattr(credential, "STORE", tmp_path)
    assert tls("credential:plc.key").key == tmp_path / "plc.key"


def found(file: Path, state: Path | None = None) -> list[tuple[Path, str]]:
    settings: Any = load(file)
    with_key = settings.plc.model_copy(update={"tls": tls("plc.key").under(file.parent)})
    return [(m.path, m.remedy) for m in misfits(file, settings.model_copy(update={"plc": with_key}), state)]


def test_files_kept_from_others_are_right(copied: Path) -> None:
    assert found(copied, copied.parents[1] / "state") == []
    assert found(copied) == []


@pytest.mark.parametrize(
    ("name", "mode", "remedy"),
    [
        ("etc/demo.yaml", 0o666, "chmod o-w"),
        ("etc", 0o777, "chmod o-w"),
        ("etc/calibration/demo.yaml", 0o646, "chmod o-w"),
        ("etc/plc.key", 0o640, "chmod 600"),
        ("etc/plc.key", 0o604, "chmod 600"),
        ("state", 0o770, "chmod go-w"),
    ],
)
def test_what_others_may_do_is_named_with_the_remedy(copied: Path, name: str, mode: int, remedy: str) -> None:
    path = copied.parents[1] / name
    path.chmod(mode)
    ((where, said),) = found(copied, copied.parents[1] / "state")
    assert where == path
    assert said.startswith(remedy)


def test_a_folder_for_state_that_is_another_s_or_is_not_there_is_named(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = copied.parents[1] / "state"
    user = os.geteuid() + 1
    monkeypatch.setattr(os, "geteuid", lambda: user)
    assert [(where, said.split()[0]) for where, said in found(copied, state)] == [(state, "chown")]
    assert [where for where, _ in found(copied, state / "none")] == [state / "none"]


def test_a_credential_may_be_read_by_its_mode_which_is_systemd_s(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (copied.parent / "plc.key").chmod(0o440)
    monkeypatch.setenv(credential.FOLDER, str(copied.parent))
    assert found(copied) == []
