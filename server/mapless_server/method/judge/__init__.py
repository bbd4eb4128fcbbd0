"""Acceptance of a pose.

`judge` computes, for poses that pass the gate (see `pnp`), a trust from the evidence (`evidence`), and rejects by it,
where a second pose explains the photograph, and by `intrinsics` (the photograph contradicts its own) and `cameras`
(another camera explains its matches better). `two_view` accepts poses that rest on matches with references.
"""
