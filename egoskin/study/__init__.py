"""Studies: sets of runs that differ in a few fields, compared over seeds.

* `fields`: fields of a training configuration by dotted name
* `manifest`: definition of a study: cells, seeds, budget, evaluation
* `shipped`: the studies that come with the package
* `cost`: estimate of a study's cost
* `folder`: the study folder: state and result of each run
* `stored`: the files of a finished run
* `claims`: locks, so that only one process works on a run, on one host or many
* `evaluation`: a policy on the study's throw set
* `job`: one run and its evaluation, in its own process
* `runner`: execution of the runs in parallel
* `ray_runner`: the same on a Ray cluster
* `metrics`: the metrics of a run
* `statistics`: estimates over seeds, tests, power
* `findings`: the paper's findings as contrasts, fixed before any run
* `differences`: of cells to the first one
* `figures`: figures of the report
* `page`: a text in Markdown as one HTML page
* `report`: report.md, index.html, runs.csv
"""
