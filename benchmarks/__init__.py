"""Scripts that show what the program is worth, by what they show.

accuracy    errors of numbers and files, where the truth or another log is known
trust       whether stated errors, named faults and promises hold, and what damaged input does
motors      what happens to arms that motors move
speed       time and memory

README.md has the command of each, what it shows, and where its figures stand.
"""
