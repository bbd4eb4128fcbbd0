"""Retrieval in a large scene: time, memory, recall and start, with vectors that are planted or of photographs."""
