"""What a person looks at: overlays, and later tables, figures and pages."""
