"""Speed of each part compared with a reference in the same run (make bench), and accuracy (make benchmark-embedded)."""
