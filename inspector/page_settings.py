"""What the operator's page must be told: where browsers reach it, where it reaches the station, and who may command."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from firmware_bridge.strict import Strict

FilePath = Annotated[Path, Field(strict=False)]


class PageSettings(Strict):
    """The operator's page, served by `inspector page`, a process of its own; the service reads nothing of this."""

    host: str = Field("127.0.0.1", min_length=1)
    """Address of this machine that browsers reach; 0.0.0.0 for all of them, and then with a password or without
    commands."""
    port: int = Field(8080, ge=0, le=65535)
    """TCP port of the page; 0 takes any free one."""
    names: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    """Names and addresses by which browsers call the page, besides localhost and `host`; other ones are refused."""
    station_host: str | None = Field(None, min_length=1)
    """Where the station's registers are served; null: on this machine, as `plc.host` says."""
    station_port: int | None = Field(None, ge=1, le=65535)
    """Their TCP port; null: `plc.port`."""
    allow_commands: bool = True
    """Whether people may change the recipe, clear faults and reset the statistics here. The station must let the page's
    address write too (`plc.allow_write`)."""
    password_file: FilePath | None = None
    """File with the password that each command then asks for, made by `inspector page --set-password`; null: none."""
    texts_file: FilePath | None = None
    """YAML file with texts in place of the page's own, by key (`inspector page --print-texts`); null: English."""

    @property
    def is_local(self) -> bool:
        """Whether only this machine reaches the page."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    @model_validator(mode="after")
    def _guarded(self) -> Self:
        if self.allow_commands and self.password_file is None and not self.is_local:
            allowed = "a loopback address, or a password_file, or allow_commands: false"
            raise ValueError(
                f"others than this machine could command the station by host {self.host}; allowed: {allowed}"
            )
        return self

    def under(self, folder: Path) -> PageSettings:
        """The same settings with relative paths taken from ``folder``."""
        names = ("password_file", "texts_file")
        files = {name: folder / file for name in names if (file := getattr(self, name)) is not None}
        return self.model_copy(update=files)
