"""`make audit`: what is known against the locked dependencies, as `pip-audit --format json` says on stdin.

Where the service of advisories is out of reach that is said, and nothing is taken for sound.
"""

from __future__ import annotations

import json
import sys

FOUND = 1


def main() -> int:
    """Say what was found; the exit status, 0 also if nothing could be asked."""
    said = sys.stdin.read()
    if not said:
        print("NOT AUDITED: pip-audit reached nothing; build/audit/log has why")
        return 0
    asked = json.loads(said)["dependencies"]
    skipped = [part["name"] for part in asked if "skip_reason" in part]
    known = [(part, flaw) for part in asked for flaw in part.get("vulns", ())]
    for part, flaw in known:
        print(f"{part['name']} {part['version']}: {flaw['id']}, mended in {', '.join(flaw['fix_versions']) or 'none'}")
    if skipped:
        print(f"NOT AUDITED, their advisories are out of reach: {', '.join(skipped)}")
    print(f"{len(asked) - len(skipped)} of {len(asked)} dependencies audited, {len(known)} advisories")
    return FOUND if known else 0


if __name__ == "__main__":
    sys.exit(main())
