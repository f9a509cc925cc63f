"""A store on disk: its format, and the reading and checking of an episode's bytes."""
