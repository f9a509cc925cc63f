"""How results are shown: numbers, headings and tables as text, output files, progress, and what plots share."""
