"""A `core.result.Result` as a screen, files, pictures and a page. Nothing here knows a command."""
