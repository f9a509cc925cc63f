"""How things reach people: tables of text, the summary, progress at a terminal, files that appear whole."""
