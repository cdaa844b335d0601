"""Results for people: overlays, the gallery, terminal tables, and the report of many runs as one HTML page."""
