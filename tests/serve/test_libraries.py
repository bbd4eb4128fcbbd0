"""What libraries must know before they are imported."""

from __future__ import annotations

import pytest

from mapless_server.serve.libraries import hides_avx512

WIDE = "avx2 avx512f avx512cd avx512bw avx512dq avx512vl"


@pytest.mark.parametrize(
    ("cpu", "hidden"),
    [
        (f"processor\t: 0\nvendor_id\t: AuthenticAMD\nflags\t\t: {WIDE} vaes\n\nprocessor\t: 1\n", True),
        ("vendor_id\t: AuthenticAMD\nflags\t\t: avx2 avx512f\n", False),
        (f"vendor_id\t: GenuineIntel\nflags\t\t: {WIDE}\n", False),
        ("processor\t: 0\nBogoMIPS\t: 50.00\nFeatures\t: fp asimd\n", False),
        ("", False),
        ("no colon\n:\n", False),
    ],
)
def test_amd_with_avx512_needs_its_kernels_named(cpu: str, hidden: bool) -> None:
    assert hides_avx512(cpu) is hidden
