"""Pictures of runs and maps, as PNG files and in a browser.

Drawing belongs here; computing what is drawn belongs to `results`.
"""
