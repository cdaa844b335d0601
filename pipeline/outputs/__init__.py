"""Answers and scores of a run -> its files.

folder.py    where the files of a run are
files.py     csv, poses.json and detections.json
pictures.py  overlays and the gallery
records.py   the run's record, from which reports are made
"""
