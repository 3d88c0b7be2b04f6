"""Fixtures for all tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder named by COLMAP_VG_DATA; tests that need it are skipped where it is unset."""
    folder = os.environ.get("COLMAP_VG_DATA")
    if not folder:
        pytest.skip("COLMAP_VG_DATA is not set")
    return Path(folder).resolve()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--run-slow", action="store_true", help="Run the slow tests, too, as with COLMAP_VG_DATA.")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--run-slow") or os.environ.get("COLMAP_VG_DATA"):
        return
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.skip(reason="slow: give --run-slow or set COLMAP_VG_DATA"))
