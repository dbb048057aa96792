"""Camera poses from points on a body: perspective-n-point, factor graphs, triangulation, arcs."""
