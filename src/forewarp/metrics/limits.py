"""Sizes and thresholds that metrics and their list share; reading them loads no torch."""

SSIM_LEAST_SIDE, MS_SSIM_LEAST_SIDE, LPIPS_LEAST_SIDE = 11, 161, 32  # pixels
NETS = "squeeze", "vgg", "alex"  # backbones of LPIPS
THRESHOLDS = (1.02, 1.25, 1.25**2)  # ratios of rendered and true depth
