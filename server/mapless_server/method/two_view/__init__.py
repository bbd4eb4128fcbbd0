"""Pose from two-view matches, where references share too little to triangulate points. Begin with `solve`."""
