"""What the tests of several rooms share: servers, stores, planted scenes, damaged files."""
