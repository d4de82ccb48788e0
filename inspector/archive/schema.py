"""The store's tables, as the steps that make them: a store of version n has had the first n.

Rules. A step that has been released never changes; a new version is a new step. Tables are read by plants' own tools
and by older programs after a downgrade: steps add, they do not rename or take away, and what they add has a default. A
step that an older program could not live with raises :data:`OLDEST_WRITER` to its own number.

``id`` names a result for good: number of the run in the upper 32 bits, ``sequence`` in the lower. Times are Unix time,
seconds; verdicts, reasons and flags are the numbers of the register map.
"""

from __future__ import annotations

STEPS = (
    """
    CREATE TABLE run (
        id INTEGER PRIMARY KEY,
        started_s REAL NOT NULL,
        program TEXT NOT NULL,
        station TEXT NOT NULL,
        ended_s REAL
    );
    CREATE TABLE settings_version (
        name TEXT PRIMARY KEY,
        first_used_s REAL NOT NULL,
        text TEXT NOT NULL
    ) WITHOUT ROWID;
    CREATE TABLE recipe_version (
        hash TEXT PRIMARY KEY,
        recipe_id INTEGER NOT NULL,
        name TEXT NOT NULL,
        first_used_s REAL NOT NULL,
        text TEXT NOT NULL
    ) WITHOUT ROWID;
    CREATE TABLE result (
        id INTEGER PRIMARY KEY,
        sequence INTEGER NOT NULL,
        at_s REAL NOT NULL,
        panel_id INTEGER NOT NULL,
        verdict INTEGER NOT NULL,
        reasons INTEGER NOT NULL,
        reasons_text TEXT NOT NULL,
        fault_code INTEGER NOT NULL,
        settings TEXT NOT NULL,
        recipe TEXT NOT NULL,
        recipe_id INTEGER NOT NULL,
        defect_count INTEGER NOT NULL,
        unpaired_count INTEGER NOT NULL,
        largest_height_um REAL,
        frame_count INTEGER NOT NULL,
        area_m2 REAL,
        acquisition_id INTEGER NOT NULL,
        lamp_set_v REAL NOT NULL,
        lamp_read_v REAL NOT NULL,
        exposure_us REAL NOT NULL,
        elapsed_us REAL NOT NULL,
        cycle_us REAL NOT NULL,
        missed_triggers INTEGER NOT NULL,
        simulated INTEGER NOT NULL,
        degraded INTEGER NOT NULL
    );
    CREATE INDEX result_at ON result (at_s);
    CREATE INDEX result_sequence ON result (sequence);
    CREATE TABLE frame (
        result INTEGER NOT NULL REFERENCES result (id),
        number INTEGER NOT NULL,
        frame_id INTEGER NOT NULL,
        name TEXT NOT NULL,
        taken_at_s REAL NOT NULL,
        exposure_us REAL,
        exposure_set_us REAL NOT NULL,
        lamp_v REAL,
        lamp_set_v REAL NOT NULL,
        travel_mm REAL NOT NULL,
        verdict INTEGER NOT NULL,
        reasons INTEGER NOT NULL,
        kept TEXT,
        image TEXT,
        PRIMARY KEY (result, number)
    ) WITHOUT ROWID;
    CREATE TABLE defect (
        result INTEGER NOT NULL REFERENCES result (id),
        number INTEGER NOT NULL,
        x_mm REAL,
        y_mm REAL,
        height_um REAL,
        height_sigma_um REAL,
        direct_x_px REAL,
        direct_y_px REAL,
        mirror_x_px REAL,
        mirror_y_px REAL,
        flags INTEGER NOT NULL,
        residual_sigma REAL,
        sunk_bias_um REAL,
        place_sigma_mm REAL,
        PRIMARY KEY (result, number)
    ) WITHOUT ROWID;
    CREATE TABLE fault (
        began_s REAL NOT NULL,
        code INTEGER NOT NULL,
        run INTEGER NOT NULL REFERENCES run (id),
        sequence INTEGER NOT NULL,
        ended_s REAL,
        PRIMARY KEY (began_s, code)
    ) WITHOUT ROWID;
    CREATE TABLE action (
        at_s REAL PRIMARY KEY,
        run INTEGER NOT NULL REFERENCES run (id),
        who TEXT NOT NULL,
        what TEXT NOT NULL,
        detail TEXT NOT NULL
    ) WITHOUT ROWID;
    CREATE TABLE lamp (
        at_s REAL PRIMARY KEY,
        run INTEGER NOT NULL REFERENCES run (id),
        burnt_hours REAL NOT NULL
    ) WITHOUT ROWID;
    CREATE TABLE about (
        key TEXT PRIMARY KEY,
        value TEXT NOT NULL
    ) WITHOUT ROWID;
    """,
)
OLDEST_WRITER = 1
"""The first version whose program can go on writing into a store that has had all steps."""
RUN_BITS = 32
