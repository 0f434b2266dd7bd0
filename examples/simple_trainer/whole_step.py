"""The whole step in gsplat's trainer: ``python whole_step.py SIMPLE_TRAINER.py``.

What is between the quotes, the trainer's own step, is not run any more. Evaluation, checkpoints, log and viewer stay.
"""

from editing import command_line

EDITS = '''
 from gsplat.strategy import DefaultStrategy, MCMCStrategy
+from turbogs_plugin.gsplat_bridge import TurboStep
@@
         global_tic = time.time()
+        host = {"optimizers": self.optimizers, "options": cfg, "scene": vars(self).get("scene")}
+        turbo = TurboStep(self.splats, self.trainset, self.scene_scale, max_steps, **host)
@@
+            info = turbo.step(step)
+            """
             try:
                 data = next(trainloader_iter)
@@
+            """
+            loss, num_train_rays_per_step = info.loss, info.num_samples
             # write images (gt and render)
@@
-                self.writer.add_scalar("train/l1loss", l1loss.item(), step)
-                self.writer.add_scalar("train/ssimloss", ssimloss.item(), step)
@@
+                data["turbo"] = turbo.state_dict()
                 if cfg.pose_opt:
                     if world_size > 1:
                         data["pose_adjust"] = self.pose_adjust.module.state_dict()
'''

if __name__ == "__main__":
    command_line(EDITS)
