"""Checks that a page is whole: nothing wider than the screen, words that can be read, in both looks and at three sizes."""

from playwright.sync_api import Page

from support.fleet.dashboard_scene import wait_until

SIZES = ((1280, 800), (820, 1180), (360, 740))

# Contrast (WCAG 2) of all words with the nearest ground that is painted behind them: the weakest, and its words.
WEAKEST_CONTRAST = """() => {
  const numbers = text => (text.match(/[\\d.]+/g) || []).map(Number);
  const light = rgb => rgb.map(v => v / 255).map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, n) => sum + v * [0.2126, 0.7152, 0.0722][n], 0);
  const ground = node => {
    for (let at = node; at; at = at.parentElement) {
      const found = numbers(getComputedStyle(at).backgroundColor);
      if (found.length === 3 || found[3] === 1) return found.slice(0, 3);
    }
    return [255, 255, 255];
  };
  let weakest = [21, ''];
  for (const node of document.querySelectorAll('body *')) {
    const words = [...node.childNodes].some(child => child.nodeType === 3 && child.textContent.trim());
    if (!words || !node.checkVisibility() || node.closest('svg, style, script')) continue;
    const behind = ground(node), ink = numbers(getComputedStyle(node).color), share = ink[3] ?? 1;
    const seen = ink.slice(0, 3).map((v, n) => share * v + (1 - share) * behind[n]);
    const [a, b] = [light(seen), light(behind)].sort((one, other) => one - other);
    const contrast = (b + 0.05) / (a + 0.05);
    if (contrast < weakest[0]) weakest = [contrast, node.tagName + ' ' + node.className + ' ' + node.textContent.slice(0, 80)];
  }
  return weakest;
}"""


def assert_whole(page: Page) -> None:
    """An open page at all sizes and in both looks."""
    for look in ("light", "dark"):
        page.emulate_media(color_scheme=look)
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            wait_until(page, f"document.body.matches('.body--{look}, .print')")
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), (
                f"{page.url} is wider than {width}"
            )
            fits = "!document.body.matches('.console') || document.documentElement.scrollHeight <= innerHeight"
            assert page.evaluate(fits), f"{page.url} scrolls as a whole"
            contrast, words = page.evaluate(WEAKEST_CONTRAST)
            assert contrast >= 4.5, f"{page.url}, {look}: {words}"
    narrow_px = page.evaluate(
        "Math.min(999, ...[...document.querySelectorAll('dl.facts dd')].map(dd => dd.offsetWidth))"
    )
    assert narrow_px > 100, f"{page.url}: words are broken into letters"
