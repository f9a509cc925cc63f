"""Writing a store: codecs, episodes, the root, files that survive a crash, the disk estimate. Needs no torch."""
