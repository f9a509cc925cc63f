"""The report: one self-contained HTML file. `report_html` is all of it; the other modules are its parts."""
