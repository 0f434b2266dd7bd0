"""Moment-damped LM in gsplat's trainer: ``python moment_lm.py SIMPLE_TRAINER.py``."""

from editing import command_line

EDITS = """
 from gsplat.strategy import DefaultStrategy, MCMCStrategy
+from turbogs_plugin.gsplat_bridge import SharedOptimizer
+from turbogs_plugin.strategies import MomentLMOptimizer
@@
-        optimizer_class = torch.optim.Adam
+        optimizer_class = SharedOptimizer(MomentLMOptimizer())
"""

if __name__ == "__main__":
    command_line(EDITS)
