"""Words for the reasons of rejections, the same wherever people read of them."""

WORDS = {
    "LOW_OVERLAP": "too little in common with the references",
    "GATE": "the evidence for a pose does not suffice",
    "TOO_FEW_MATCHES": "too few matches have a point",
    "PNP_FAILED": "no pose explains the matches",
    "AMBIGUOUS": "two places look alike",
    "PRIOR_CONFLICT": "the pose contradicts the priors",
    "LOW_TEXTURE": "the photograph shows too little texture",
    "NO_USABLE_REFERENCES": "no reference can be used",
    "DEGENERATE_REFERENCES": "the references stand at one position",
    "SCALE_UNRELIABLE": "the references give no scale",
}


def explained(reason: str) -> str:
    """A reason by its name and in words, "AMBIGUOUS: two places look alike"; one of a newer server by its name."""
    return f"{reason}: {WORDS[reason]}" if reason in WORDS else reason
