"""Sparse pixels in gsplat's trainer: ``python sparse_pixels.py SIMPLE_TRAINER.py``; then train with ``--batch_size 4``.

What needs whole images is refused (a bilateral grid, post-processing, the depth loss); so does ``--tb_save_image``.
"""

from editing import command_line

EDITS = """
 from gsplat.strategy import DefaultStrategy, MCMCStrategy
+from turbogs_plugin.gsplat_bridge import gather_pixels, maps_of_photos
+from turbogs_plugin.gsplat_bridge import sparse_budget, sparse_loss, sparse_rasterization
+from turbogs_plugin.strategies import CharbonnierNccLoss, ErrorGuidedPixelSampler
+from turbogs_plugin.types import Step
@@
-        render_colors, render_alphas, info = rasterization(
+        rasterize = sparse_rasterization if "samples" in kwargs else rasterization
+        render_colors, render_alphas, info = rasterize(
@@
+        budget = sparse_budget(len(self.trainset), cfg.batch_size, cfg)
+        maps = maps_of_photos(self.trainset, device)
+        sampler = ErrorGuidedPixelSampler()
         # Training loop.
@@
-            masks = data["mask"].to(device) if "mask" in data else None  # [1, H, W]
+            masks = None  # the maps have them
@@
+            now = Step(step, max_steps, max_steps)
+            samples = sampler.sample(maps, data["image_id"].tolist(), budget.rate, now)
+            pixels = gather_pixels(pixels, samples)  # [P, 3]
             # forward
@@
+                samples=samples,
             )
             if renders.shape[-1] == 4:
@@
-            l1loss = F.l1_loss(colors, pixels)
-            ssimloss = 1.0 - fused_ssim(
-                colors.permute(0, 3, 1, 2), pixels.permute(0, 3, 1, 2), padding="valid"
-            )
-            loss = l1loss * (1.0 - cfg.ssim_lambda) + ssimloss * cfg.ssim_lambda
+            loss = sparse_loss(CharbonnierNccLoss(), colors, pixels, samples, maps, now)
@@ or
-            if masks is not None:
-                # Exclude masked pixels (e.g. ego vehicle) from L1.
-                # For SSIM (patch-based), zero out both sides at masked locations
-                # so masked patches don't pull colors toward an arbitrary value.
-                l1loss = l1_loss(colors[masks], pixels[masks]).mean()
-                colors_ssim = colors * masks[..., None]
-                pixels_ssim = pixels * masks[..., None]
-            else:
-                l1loss = l1_loss(colors, pixels).mean()
-                colors_ssim = colors
-                pixels_ssim = pixels
-            ssimloss = ssim_loss(
-                colors_ssim.permute(0, 3, 1, 2), pixels_ssim.permute(0, 3, 1, 2)
-            )
-            loss = torch.lerp(l1loss, ssimloss, cfg.ssim_lambda)
+            loss = sparse_loss(CharbonnierNccLoss(), colors, pixels, samples, maps, now)
@@
-                self.writer.add_scalar("train/l1loss", l1loss.item(), step)
-                self.writer.add_scalar("train/ssimloss", ssimloss.item(), step)
"""

if __name__ == "__main__":
    command_line(EDITS)
