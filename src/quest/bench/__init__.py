"""Every table of the publication, made again: takes, trainings, answers and rows of each, as far as they are missing.

What comes in is the name of a table and a folder to work in; what goes out is that table as JSON, Markdown, LaTeX and
pictures. ``tables`` says what each is made of, ``workbench`` makes it.
"""
