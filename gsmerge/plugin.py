"""What a package that adds a method or a command imports; see docs/internals/adding.md.

    from gsmerge.plugin import Method, Plan, Prepared

- ``Method``: a method of compacting a scene, which an entry point of the group ``gsmerge.methods`` names
- ``Prepared``: a scene in its canonical frame, with ``scene``, ``reference``, ``frame`` and what was done to it
- ``Plan``: the decisions of a run, with ``count``, ``merge``, ``fit``, ``score`` and ``seed``
- ``prepare``: what prepares a scene for a method; ``without`` names the steps that it leaves out
- ``stage``: a block of a method whose seconds a run reports; ``note``: a sentence for its report
- ``GsmergeError``, ``SceneError``, ``UsageError``: end a command with one line and an exit code
"""

from __future__ import annotations

from gsmerge.errors import GsmergeError as GsmergeError
from gsmerge.errors import SceneError as SceneError
from gsmerge.errors import UsageError as UsageError
from gsmerge.method.facts.prepared import Prepared as Prepared
from gsmerge.method.pipelines.plan import Plan as Plan
from gsmerge.plan.methods import Method as Method
from gsmerge.prepare.prepare_scene import prepare as prepare
from gsmerge.prepare.steps import without as without
from gsmerge.runtime.record import note as note
from gsmerge.runtime.record import stage as stage
