"""A scene in memory: its references with their features, its retrieval index, its audit.

May import store, security, method, networks and images. Begin with `library` (references), `indexes` (retrieval) and
`auditing`.
"""
