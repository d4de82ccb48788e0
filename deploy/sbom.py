"""The software bill of materials, CycloneDX 1.6: every distribution in a tree of site-packages, with its licence.

Beside each stand the native libraries that it brings along. It is read off the tree itself, so it says what is there.
"""

from __future__ import annotations

import hashlib
import json
import re
import uuid
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import Any


def bill(site: Path, program: str) -> str:
    """The document as JSON, the same for the same tree; ``program`` is the distribution that it is the bill of."""
    found = sorted(distributions(path=[str(site)]), key=name_of)
    (subject,) = [d for d in found if name_of(d) == program]
    parts = [component(d, site) for d in found if d is not subject]
    document = {
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": "",
        "version": 1,
        "metadata": {"component": component(subject, site) | {"type": "application"}},
        "components": parts,
        "dependencies": [{"ref": reference(subject), "dependsOn": [part["bom-ref"] for part in parts]}],
    }
    number = uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(document))
    return json.dumps(document | {"serialNumber": f"urn:uuid:{number}"}, indent=2) + "\n"


def component(found: Distribution, site: Path) -> dict[str, Any]:
    """A distribution as the bill lists it."""
    said = {
        "type": "library",
        "bom-ref": reference(found),
        "name": name_of(found),
        "version": found.version,
        "purl": reference(found),
        "licenses": [licence_of(found)],
    }
    return said | ({"components": libraries} if (libraries := native_libraries(found, site)) else {})


def reference(found: Distribution) -> str:
    """Package URL of a distribution."""
    return f"pkg:pypi/{name_of(found)}@{found.version}"


def name_of(found: Distribution) -> str:
    """A distribution's name, normalised as in the lock."""
    return re.sub(r"[-_.]+", "-", found.metadata["Name"]).lower()


def licence_of(found: Distribution) -> dict[str, Any]:
    """The licence that a distribution states: as an SPDX expression, or by the name it gives."""
    if expression := found.metadata["License-Expression"]:
        return {"expression": expression}
    classified = [c for c in found.metadata.get_all("Classifier") or [] if c.startswith("License :: ")]
    name = classified[0].split(" :: ")[-1] if classified else found.metadata["License"] or "not stated"
    return {"license": {"name": name.splitlines()[0]}}


def native_libraries(found: Distribution, site: Path) -> list[dict[str, Any]]:
    """Shared libraries of others that a wheel brings along, as `auditwheel` puts them beside it."""
    names = sorted(str(f) for f in found.files or () if f.parts[0].endswith(".libs"))
    return [
        {
            "type": "library",
            "bom-ref": f"{reference(found)}#{name}",
            "name": Path(name).name,
            "hashes": [{"alg": "SHA-256", "content": hashlib.sha256((site / name).read_bytes()).hexdigest()}],
        }
        for name in names
    ]
