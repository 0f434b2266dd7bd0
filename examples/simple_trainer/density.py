"""Error-driven density control in gsplat's trainer: ``python density.py SIMPLE_TRAINER.py``.

Gaussians grow and go by squares of screen gradients; `errors.py` adds the line that ranks them by error.
"""

from editing import command_line

EDITS = """
 from gsplat.strategy import DefaultStrategy, MCMCStrategy
+from turbogs_plugin.gsplat_bridge import TurboDensityStrategy
@@
-                strategy=DefaultStrategy(verbose=True),
+                strategy=TurboDensityStrategy(verbose=True),
"""

if __name__ == "__main__":
    command_line(EDITS)
