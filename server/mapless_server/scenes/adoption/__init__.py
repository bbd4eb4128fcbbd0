"""Decisions on values: localized photographs that become references of a scene, and references that are retired.

May import what `scenes` may. Begin with `policy`; `serve.adoption` runs it after answers, and `store.adoption` keeps
what it decides. Why it is as it is: decision 042-adoption.
"""
