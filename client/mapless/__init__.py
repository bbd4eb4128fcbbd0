"""mapless: visual localization without a map; the client."""
