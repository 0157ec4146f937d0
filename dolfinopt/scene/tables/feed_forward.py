"""`[feed_forward]`: joint motions under which the bending arms carry the tip along its path."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from dolfinopt.scene.tables.base import Duration, Instant, Refusal, Table, Use, shown

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

LEAD_SHARE = 0.05  # of the motion's duration: pre-actuation fades within milliseconds


class FeedForward(Table):
    """Corrections of joints that keep the tip of the flexible machine on the rigid one's path."""

    USES = (Use("joints spacing lead", "kind", "tip"),)

    kind: Literal["none", "tip"] = "none"
    joints: tuple[str, ...] | None = None
    spacing: Duration | None = None
    lead: Instant | None = None

    @property
    def on(self) -> bool:
        """Whether joints are corrected."""
        return self.kind != "none"

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse what nothing uses, joints that are no drives, and motions without a free tip."""
        if not self.on:
            return
        if scene.control is not None and scene.control.feed_forward != "tip":
            raise Refusal(
                'expected "none" with [control], unless control.feed_forward = "tip"',
                ".kind",
                "control.feed_forward",
            )
        if scene.is_pinned:
            raise Refusal(
                'expected "none": a pin holds the end-effector, which has no path', ".kind"
            )
        if scene.motion.table_ends == "moving":
            raise Refusal(
                'expected "rest" with feed_forward.kind = "tip", whose corrections begin at rest',
                "motion.table_ends",
                ".kind",
            )
        for name in self.joints or ():
            if name not in scene.driven:
                known = ", ".join(scene.driven)
                raise Refusal(f"expected drives, of {known}; {shown(name)} is none", ".joints")
