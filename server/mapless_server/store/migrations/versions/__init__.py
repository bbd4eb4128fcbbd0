"""The steps, by the revision to which they lead."""
