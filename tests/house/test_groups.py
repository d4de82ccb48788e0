"""What several tests have in common is made once, by the worker that has them all: where `make test` runs beside."""

from __future__ import annotations

import os

import pytest


@pytest.mark.xdist_group("a group")
def test_tests_of_a_group_are_told_apart(request: pytest.FixtureRequest) -> None:
    if "PYTEST_XDIST_WORKER" in os.environ and request.config.getoption("loadgroup"):
        assert request.node.nodeid.endswith("@a group")
