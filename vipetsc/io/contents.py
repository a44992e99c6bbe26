"""What ``run.h5`` holds: units and names."""

# Name in the file: dimensions, units, text. What a chunk holds besides fields, and what is known from the beginning.
SAMPLED = {
    "time": ("time", "s", "time"),
    "field_time": ("field_time", "s", "time of the recorded fields"),
    "energy/kinetic": ("time", "J", "kinetic energy"),
    "energy/spring": ("time", "J", "energy of the springs"),
    "energy/contact": ("time", "J", "elastic energy of the contacts"),
    "energy/work": ("time", "J", "work done by the drive"),
    "energy/dissipated": ("time", "J", "energy dissipated in contacts"),
}
# Fields, losses and the log of contacts, of which ranks that write together hold their own alone.
LOSSES = "energy/dissipated_by_site"
LARGE = {
    "displacement": ("field_time cell dof", "m", "displacement of each mass"),
    "velocity": ("field_time cell dof", "m/s", "velocity of each mass"),
    LOSSES: ("time site", "J", "energy dissipated at each site"),
    "episode": ("episode", "1", "contact episode, by onset"),
    "impacts/site": ("episode", "1", "site, counted from 1"),
    "impacts/side": ("episode", "1", "side of the clearance: +1 or -1"),
    "impacts/onset": ("episode", "s", "time of onset"),
    "impacts/approach_velocity": ("episode", "m/s", "relative velocity at onset, w'_minus"),
    "impacts/separation": ("episode", "s", "time of separation; NaN if still in contact"),
    "impacts/indentation": ("episode", "m", "largest indentation"),
    "impacts/force": ("episode", "N", "largest contact force"),
    "impacts/loss": ("episode", "J", "energy dissipated in the episode"),
}
GIVEN = {
    "cell": ("cell", "1", "cell, counted from 1"),
    "dof": ("dof", "1", "mass within the cell, from 1"),
    "site": ("site", "1", "contact site, from 1"),
    "sites/cell": ("site", "1", "cell of the site"),
    "sites/clearance": ("site", "m", "clearance of the site"),
}
