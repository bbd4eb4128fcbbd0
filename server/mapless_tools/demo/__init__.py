"""The demo: a rendered room, a server as its own process, and pictures that a person can judge at a glance."""
