"""Pose from matches with the references themselves, where they share too little to triangulate: begin with `solve`."""
