"""The experiment of Kim & Kim (Sensors 2022), its methods, figures and tables: `gpom paper`.

Rooms, from the ground up: `experiment` (what is true and what was measured), `grids` and `methods`
(the maps), `regions` (where they are scored), `trials` (one seed), `costs` and `kernels`
(complexity, quadrature), `tables` and `figures` (what is shown), `command`.
"""
