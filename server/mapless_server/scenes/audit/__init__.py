"""Audit and coverage: whether references are right, and where a photograph would be localized with them.

Begin with `scene_auditor`, which audits a stored scene; `auditor` has the decisions about one reference. It compares
(`comparison`) the points that neighbours triangulate (`neighbourhood`) with the reference's photograph, by fitting its
camera (`resection`). `finder` finds neighbours, `change` detects changes of the scene, `verdict` has the results.
`coverage` predicts matches from the points that would be visible (`neighbourhood`).
"""
