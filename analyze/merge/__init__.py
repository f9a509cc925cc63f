"""`vla-analyze merge`: one store of the episodes of several stores of one run."""
