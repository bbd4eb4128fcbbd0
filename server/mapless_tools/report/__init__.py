"""The page of a scene's report: where photographs fail, on a plan, and where references would help.

    command > page (HTML) > plan, charts (drawing) > places (what is drawn where, and its colour)

It is a client like any other. Begin reading with `places`.
"""
