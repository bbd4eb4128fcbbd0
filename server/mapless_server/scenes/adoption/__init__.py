"""Which localized photographs become references of a scene, and which references are retired: decisions on values.

May import what `scenes` may. Begin with `policy`; `serve.adoption` runs it after answers, and `store.adoption` keeps
what it decides. Why it is as it is: decision 042-adoption.
"""
