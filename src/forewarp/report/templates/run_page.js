"use strict";
// Without this script truth and prediction stand beside each other.
for (const pair of document.querySelectorAll(".pair")) {
  const cut = pair.querySelector("input");
  if (!cut) continue;
  const show = () => {
    pair.style.setProperty("--cut", cut.value + "%");
    cut.setAttribute("aria-valuetext", `${cut.value} % truth, ${100 - cut.value} % prediction`);
  };
  cut.addEventListener("input", show);
  cut.hidden = false;
  pair.classList.add("over");
  show();
}
if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
  for (const video of document.querySelectorAll("video")) {
    video.autoplay = false;
    video.pause();
  }
}
