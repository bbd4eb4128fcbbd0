"""Acceptance of a pose.

`judge` computes, for poses that pass the gate (see `pose.pnp`), a trust from the evidence (`evidence`), and rejects by
it, where a second pose explains the photograph, and by `cameras`: the photograph contradicts its intrinsics. `two_view`
accepts poses that rest on matches with references, `references` poses whose references agree with one another. `answer`
is the result, `hints` what would help after a rejection.
"""
