"""Pages for people: one self-contained HTML file with a drawn map and sortable tables."""
