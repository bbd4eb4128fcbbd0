"""Acceptance of a pose.

`judge` computes, for poses that pass the gate (see `pose.pnp`), a trust from the evidence (`evidence`), and rejects by
it, where a second pose explains the photograph, and where the photograph contradicts its intrinsics: by the equations
of the adjustment (`intrinsics`), or by the poses of other cameras (`cameras`). `two_view` accepts poses that rest on
matches with references, `references` poses whose references agree with one another. `answer` is the result, `hints`
what would help after a rejection.
"""
