"""Data sets that attack memory and time, in their meta files, tables, pictures and videos."""
