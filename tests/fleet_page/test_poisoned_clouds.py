"""Maps that hold numbers to spoil the page that draws them."""

from __future__ import annotations

import contextlib

import pytest

from rse_pf.errors import RsePfError
from rse_pf.extensions.fleet_page.clouds import packer
from tests.kit.hostile_maps import hostile_maps


@pytest.mark.parametrize("name", sorted(hostile_maps()))
def test_what_draws_a_map_refuses_or_survives_it(name: str) -> None:
    with contextlib.suppress(RsePfError):
        packer("")(hostile_maps()[name])
