"""The info line in gsplat's trainer, after `density.py`: ``python errors.py SIMPLE_TRAINER.py``."""

from editing import command_line

EDITS = """
+            info.update(prediction=colors, ground_truth=pixels)
             loss.backward()
"""

if __name__ == "__main__":
    command_line(EDITS)
