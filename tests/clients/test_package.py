"""What the package offers at its door."""

import subprocess
import sys

import pytest

import clients


@pytest.mark.parametrize("name", clients.__all__)
def test_every_public_name_is_there(name):
    assert getattr(clients, name).__name__ == name


def test_other_names_are_not():
    with pytest.raises(AttributeError, match="no attribute 'Mapp'"):
        clients.Mapp  # noqa: B018 - the access is the test


def test_asking_the_map_needs_no_zenoh():
    program = "import sys, clients; clients.MapClient; sys.exit('zenoh' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
