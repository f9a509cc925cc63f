"""One file a question: a function of a checked question that returns a `core.result.Result`."""
