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
