"""One capture run: its settings, its command, and the filling of a store."""
