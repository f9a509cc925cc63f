"""Stage one: runs a policy in a simulator and records the attention rows of its action queries."""
