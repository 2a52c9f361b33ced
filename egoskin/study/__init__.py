"""Studies: many runs that differ in a few fields, and what their seeds tell.

* `manifest`: what is run: cells, seeds, budget, evaluation
* `shipped`: the studies that come with the package
* `cost`: what a study costs
* `store`: a study as a folder: what of it is done, and with what result
* `claims`: one process a run, on one host or many
* `job`: a run and its evaluation, in a process of its own
* `runner`: the runs of a study, side by side
* `statistics`: estimates over seeds, tests, power
* `findings`: the paper's findings as contrasts, fixed before any run
* `figures`: pictures
* `report`: report.md, index.html, runs.csv
"""
