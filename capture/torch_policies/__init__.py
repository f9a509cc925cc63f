"""Recording any torch policy: attention calls, layouts that say what the calls are, and sessions that store them."""
