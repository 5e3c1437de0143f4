"""Speed, memory and accuracy against peers and limits. Nothing here is part of the package.

* `metrics`: the one list of figures, with unit, direction, tolerance and target
* `run`: every suite in a process of its own, one JSON, one page (`page`, `drawing`)
* `suites/`: what is measured, each a module with `run(effort) -> Report` (`report`)
* `peers/`: other libraries where they are installed, and the literature's methods from their papers
* `limits`, `studies`, `timing`, `counting`, `growing`: Cramer-Rao bounds, Monte Carlo, the clock, the counters
* `accuracy_turntable`, `accuracy_world`, `seed_setup`, `corner_finding`: long studies with a page of their own
* `calibrate`, `detection`, `assemble`: single measurements that the suites use, also commands of their own

A new figure: a line in `metrics.METRICS`, and a suite that fills it in.
"""
