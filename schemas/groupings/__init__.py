"""The grouping language: selectors, groupings, the built-in ones, and the weights they give every key."""
