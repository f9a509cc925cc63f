"""Writing a store: arrays and codecs, episodes, the root, files that survive a crash, the disk estimate."""
