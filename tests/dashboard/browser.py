"""Looks at a landing in a real browser, and commands it: browser.py URL FOLDER

Says `STOP` and `CONT` when the page's server is to be stopped and to continue, `KILL` and `START` when it is to be killed and started
again, and waits for a line after each. Prints the measurements as JSON on its last line. Exit status 77: no browser, or no package to drive one.
"""

import json
import os
import re
import sys
import time
from contextlib import contextmanager
from pathlib import Path

from chromium import CHROMIUM, sync_playwright

PATIENCE_S = 60
ATTEMPTS = 5
URL, FOLDER = sys.argv[1], Path(sys.argv[2])

# How different the pixels of a canvas are, as it is shown.
SPREAD = """(selector) => {
  const copy = document.createElement('canvas');
  [copy.width, copy.height] = [64, 48];
  const context = copy.getContext('2d');
  context.drawImage(document.querySelector(selector), 0, 0, 64, 48);
  const grey = [...context.getImageData(0, 0, 64, 48).data].filter((_, n) => n % 4 === 0);
  return Math.max(...grey) - Math.min(...grey);
}"""


# How the lines of elements go: `line-through` where they are struck through.
LINES = "(selector) => [...document.querySelectorAll(selector)].map((it) => getComputedStyle(it).textDecorationLine)"
# Elements that show the state of the landing, each in its own way, and are never empty.
STATE_ELEMENTS = ["#height", "#why", "#mode", "#detector-why", "#detectors td", "#services td", "#recorders", "#checks span", "#strips span:last-child", "#video-text"]
# Whether the times of the log are short enough for one line.
SHORT_TIMES = r"[...document.querySelectorAll('#log time')].every((it) => /^\d\d:\d\d:\d\d$/.test(it.textContent))"
# The arrow has the direction, the number has no sign.
SETPOINT = r"/^(-|\d+[.]\d\d [↑↓] \d+[.]\d\d m[/]s)$/.test(document.getElementById('setpoint').textContent)"
# Whether an element is on the screen, and nothing covers it.
ON_SCREEN = """(it) => {
  const { left, right, top, bottom } = it.getBoundingClientRect();
  const isInside = left >= 0 && right <= innerWidth && top >= 0 && bottom <= innerHeight;
  return isInside && document.elementFromPoint((left + right) / 2, (top + bottom) / 2) === it;
}"""
SIGNED_ZERO = "[...document.querySelectorAll('dd')].map((it) => it.textContent).find((it) => /-0([.]0*)? /.test(it))"
CONNECTED = "document.getElementById('connection').textContent === 'connected'"
# A button that is pressed shortly and then held, before the server has answered the first press.
TWICE = """(button) => {
  const key = (kind) => button.dispatchEvent(new KeyboardEvent(kind, { key: ' ', bubbles: true }));
  ['keydown', 'keyup', 'keydown'].forEach(key);
}"""


# Deque's axe-core, the rules of accessibility that browsers' own tools check.
AXE = next((found for folder in os.environ.get("NODE_PATH", "").split(os.pathsep) if (found := Path(folder) / "axe-core/axe.min.js").is_file()), None)
# In sunlight 7:1 is required; by default axe-core requires 4.5:1.
VIOLATIONS = """async () => {
  const enhanced = document.documentElement.dataset.theme === 'sun';
  // Old values are grey, so that they are not mistaken for new ones.
  const found = await axe.run({ exclude: ['.stale', '.old'] }, { rules: { 'color-contrast-enhanced': { enabled: enhanced } } });
  const checked = found.passes.map((rule) => rule.id);
  return { checked, violations: found.violations.map((it) => `${it.impact} ${it.id}: ${it.nodes.map((node) => node.html.slice(0, 80)).join(' | ')}`) };
}"""


def accessibility(page, names):
    """Asserts that axe-core finds nothing; the rules that were checked."""
    if AXE is None:
        return None
    page.evaluate(AXE.read_text())
    # The page is blocked during the check, so values on it may be old by the end. Only violations of every attempt count.
    wrong = None
    for _ in range(ATTEMPTS):
        found = page.evaluate(VIOLATIONS)
        rules = {it.split(":")[0] for it in found["violations"]}
        wrong = rules if wrong is None else wrong & rules
        if not wrong:
            break
        time.sleep(1.0)
    assert not wrong, found["violations"]
    assert set(names) <= set(found["checked"]), found["checked"]
    return len(found["checked"])


def tab_to(page, command):
    """Presses the tab key until a command's button has the focus, which it has not while it cannot be used."""
    began = time.monotonic()
    while time.monotonic() - began < PATIENCE_S:
        if page.evaluate("document.activeElement?.dataset?.command ?? ''") == command:
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"the button {command} is not reached by the keyboard")


def press_space(page, command):
    """Gives a command by the keyboard."""

    def down():
        tab_to(page, command)
        page.keyboard.down("Space")

    give(page, command, down, lambda: page.keyboard.up("Space"))


def point_at(page, command):
    """Gives a command by the pointer."""

    def down():
        # Once it no longer moves: lines come and go above it.
        page.locator(f"button[data-command={command}]").hover(position={"x": 9, "y": 9})
        page.mouse.down()

    give(page, command, down, page.mouse.up)


def give(page, command, down, up):
    """Holds a button as long as the page asks for it; again where that had no effect, as it moved or could not be used just then."""
    for attempt in range(ATTEMPTS):
        if attempt:
            print(f"{command}: again, as the reply is: {text(page, '#reply')}", file=sys.stderr)
        wait(page, f"!document.querySelector('button[data-command={command}]').disabled")
        down()
        if holds_within(page, replied("Keep holding"), 2):
            wait(page, "!" + replied("Keep holding"))
        up()
        if holds_within(page, replied(f"{command}: accepted by the controller"), 10):
            return
    raise AssertionError(f"{command} is not accepted; the last reply: {text(page, '#reply')}")


def lose_link_while_held(page):
    """Holds a button while the link stalls: nothing may be sent once buttons cannot be used."""
    # Without the focus, which some browsers give to no button: a button that loses it gets an event.
    page.evaluate("document.activeElement.blur()")
    page.locator("button[data-command=hold]").dispatch_event("keydown", {"key": " "})
    # The link stalls as the second begins: before that is over the page counts as cut off.
    wait(page, "document.querySelector('button.holding') !== null", 5)
    with stopped():
        wait(page, "document.querySelector('button[data-command=hold]').disabled", 5)
        # The second is over meanwhile.
        time.sleep(0.3)
    wait(page, CONNECTED, 10)
    time.sleep(0.5)
    assert "nothing was sent" in text(page, "#reply"), text(page, "#reply")


def lose_answer(page):
    """Loses the connection between a command and its answer."""
    tab_to(page, "hold")
    page.keyboard.down("Space")
    # Half of the second; the page still counts as connected when it is over.
    wait(page, "document.querySelector('button.holding') !== null", 5)
    time.sleep(0.5)
    with stopped():
        wait(page, replied("Sent, waiting"), 2)
        page.keyboard.up("Space")
        wait(page, "!" + replied("Sent, waiting"), 10)
    reply = text(page, "#reply")
    assert reply.startswith("hold: ") and "may have been carried out" in reply, reply
    wait(page, CONNECTED, 10)


def abort_at_hand(page):
    """The abort and its reply are on a small screen, at the top and at the end of the page."""
    for place in ["0", "document.body.scrollHeight"]:
        page.evaluate(f"window.scrollTo(0, {place})")
        time.sleep(0.2)
        abort = page.locator("button[data-command=abort]")
        assert abort.evaluate(ON_SCREEN), abort.bounding_box()
        box = abort.bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        for _ in range(ATTEMPTS):
            page.mouse.down()
            time.sleep(0.2)
            page.mouse.up()
            if holds_within(page, replied("Released too early"), 2):
                break
        assert "too early" in text(page, "#reply"), text(page, "#reply")
        assert page.locator("#reply").evaluate(ON_SCREEN), page.locator("#reply").bounding_box()
        page.screenshot(path=FOLDER / f"at-hand-{'top' if place == '0' else 'end'}.png")
    page.evaluate("window.scrollTo(0, 0)")


def refuse_a_third(browser):
    """Opens more pages than `max_clients` allows: the last one shows it."""
    second, third = browser.new_page(), browser.new_page()
    second.goto(URL)
    wait(second, CONNECTED)
    third.goto(URL)
    wait(third, "document.getElementById('connection').textContent.includes('max_clients')", 10)
    assert text(third, "#phase") == "No data", text(third, "#phase")
    second.close()
    wait(third, CONNECTED, 10)
    third.close()


def meet_another_vehicle(browser):
    """A page whose server is replaced by that of another vehicle reloads, and reports the command that the previous server did not answer."""
    page, connections = browser.new_page(), []

    def connect(socket):
        connections.append(socket)
        server = socket.connect_to_server()
        # A command gets no answer.
        socket.on_message(lambda said: None if json.loads(said)["kind"] == "command" else server.send(said))
        if len(connections) > 1:
            server.on_message(lambda message: socket.send(re.sub('"vehicle":"[^"]+"', '"vehicle":"kestrel"', message)))

    page.route_web_socket("**/ws", connect)
    page.goto(URL)
    wait(page, CONNECTED)
    assert page.title() == f"{text(page, '#vehicle-name')} - Alight" != "kestrel - Alight", page.title()
    name = text(page, "#vehicle-name")
    wait(page, "!document.querySelector('button[data-command=hold]').disabled")
    page.locator("button[data-command=hold]").dispatch_event("keydown", {"key": " "})
    wait(page, replied("Sent, waiting"), 10)
    with page.expect_navigation():
        connections[0].close()
    wait(page, "document.getElementById('vehicle-name').textContent === 'kestrel'", 10)
    reply = text(page, "#reply")
    assert reply.startswith(f"{name}: hold: ") and "may have been carried out" in reply, reply
    begun = page.evaluate("performance.getEntriesByType('navigation')[0].type")
    assert begun == "reload", f"the page of another vehicle continues ({begun})"
    page.screenshot(path=FOLDER / "another-vehicle.png")
    page.close()


def replied(begin):
    """The condition that the last reply begins like this."""
    return f"document.getElementById('reply').textContent.startsWith('{begin}')"


def asked(action):
    print(action, flush=True)
    sys.stdin.readline()


@contextmanager
def stopped():
    """While the page's server is stopped."""
    asked("STOP")
    try:
        yield
    finally:
        asked("CONT")


def text(page, selector):
    return page.locator(selector).inner_text()


def wait(page, condition, limit_s=PATIENCE_S):
    """Waits until a condition holds on the page: how long that took, and how long the slowest of the page's answers, in seconds."""
    began = time.monotonic()
    slowest_s = holds_within(page, condition, limit_s)
    if slowest_s is None:
        reply = page.evaluate("document.getElementById('reply')?.textContent")
        raise AssertionError(f"{condition} does not hold within {limit_s} s; the last reply: {reply}")
    return [time.monotonic() - began, slowest_s]


def holds_within(page, condition, limit_s):
    """The page's slowest answer in seconds once a condition holds; None where it does not by then. The page forbids to evaluate texts,
    also for `wait_for_function`."""
    began, slowest_s = time.monotonic(), 1e-9
    while True:
        asked_s = time.monotonic()
        holds = page.evaluate(condition)
        slowest_s = max(slowest_s, time.monotonic() - asked_s)
        if holds:
            return slowest_s
        if time.monotonic() - began >= limit_s:
            return None
        time.sleep(0.02)


def main():
    measured = {}
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1440, "height": 1150})
        requests, problems, sizes = [], [], []
        page.on("request", lambda request: requests.append(request.url))
        page.on("response", lambda response: sizes.append(len(response.body())) if response.status == 200 else None)
        page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda problem: problems.append(str(problem)))
        page.goto(URL)
        wait(page, CONNECTED)
        wait(page, "document.getElementById('phase').textContent === 'Descending'")
        wait(page, "/found 1 in it/.test(document.getElementById('video-text').textContent)")
        wait(page, "document.getElementById('log').children.length > 2")
        for canvas in ["#video", "#map", "#side", "#strips canvas"]:
            assert page.evaluate(SPREAD, canvas) > 50, f"{canvas} is empty"
        # All that was fetched by then, WebSockets apart.
        measured["page_bytes"] = sum(sizes)
        measured["first_paint_ms"] = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
        assert 10_000 < measured["page_bytes"] <= 300_000, sizes
        page.screenshot(path=FOLDER / "descending.png", full_page=True)

        # The detector's rejected candidates in this frame, for as long as they are requested.
        assert text(page, "#refused-text") == ""
        page.locator("#refused").click()
        some = "/^main refused \\d+ candidates? in it.*: \\d+ \\w/.test(document.getElementById('refused-text').textContent)"
        for _ in range(20):
            wait(page, some)
            page.screenshot(path=FOLDER / "refused.png", full_page=True)
            measured["refused"] = text(page, "#refused-text")
            if page.evaluate(some):
                break
        page.locator("#refused").click()
        wait(page, "document.getElementById('refused-text').textContent === ''", 2)

        # By the pointer: held.
        point_at(page, "hold")
        wait(page, "document.getElementById('phase').textContent === 'Holding the position'")

        # All the rest by the keyboard alone: resumed, held, and landed at the end.
        for _ in range(ATTEMPTS):
            tab_to(page, "hold")
            page.keyboard.down("Space")
            time.sleep(0.4)
            page.keyboard.up("Space")
            if holds_within(page, replied("Released too early"), 2):
                break
        assert "too early" in text(page, "#reply"), text(page, "#reply")
        for command in ["resume", "hold"]:
            press_space(page, command)
            holds = "===" if command == "hold" else "!=="
            wait(page, f"document.getElementById('phase').textContent {holds} 'Holding the position'")
        assert text(page, "#phase-name") == "hold", text(page, "#phase-name")
        page.screenshot(path=FOLDER / "holding.png", full_page=True)
        # A hovering vehicle moves up and down alternately.
        for _ in range(40):
            signed = page.evaluate(SIGNED_ZERO)
            assert signed is None, f"zero with a sign: {signed}"
            assert page.evaluate(SETPOINT), text(page, "#setpoint")
            time.sleep(0.05)
        for selector in STATE_ELEMENTS:
            wait(page, f"/^none(,none)*$/.test(({LINES})({json.dumps(selector)}))", 10)

        page.locator("button[data-command=hold]").evaluate(TWICE)
        time.sleep(1.4)
        page.locator("button[data-command=hold]").dispatch_event("keyup", {"key": " "})
        wait(page, "/by the controller/.test(document.getElementById('reply').textContent)", 10)

        lose_link_while_held(page)
        lose_answer(page)
        refuse_a_third(browser)
        meet_another_vehicle(browser)

        page.set_viewport_size({"width": 360, "height": 740})
        time.sleep(0.5)
        width = page.evaluate("document.documentElement.scrollWidth")
        measured["accessibility"] = accessibility(page, ["color-contrast", "button-name"])
        assert width <= 360, f"a telephone would have to scroll sideways: {width} px"
        abort_at_hand(page)
        boxes = [panel.bounding_box() for panel in page.locator(".panel").all()]
        assert len(boxes) > 10 and all(box["x"] >= 0 and box["x"] + box["width"] <= 360 and box["height"] > 40 for box in boxes), boxes
        # Nothing of a table is cut off, and panels for the time before the flight come before those for later.
        page.set_viewport_size({"width": 390, "height": 844})
        time.sleep(0.5)
        for table in page.locator(".scroll").all():
            cut = table.evaluate("(it) => it.scrollWidth - it.clientWidth")
            assert cut <= 0, f"{cut} px of a table are cut off"
        assert page.locator("#services td").first.evaluate("(it) => getComputedStyle(it, '::before').content") == '"Process"'
        tops = [page.locator(it).bounding_box()["y"] for it in ["#commands-title", "#checks-title", "#strips-title", "#detectors-title"]]
        assert tops == sorted(tops), tops
        page.screenshot(path=FOLDER / "telephone.png", full_page=True)
        assert page.evaluate(SHORT_TIMES), "a time in the log is long"
        # Neither on a screen that is not wide.
        page.set_viewport_size({"width": 1280, "height": 800})
        time.sleep(0.5)
        for table in page.locator(".scroll").all():
            cut = table.evaluate("(it) => it.scrollWidth - it.clientWidth")
            assert cut <= 0, f"{cut} px of a table are cut off on a screen"
        page.set_viewport_size({"width": 1440, "height": 1150})
        page.locator("#theme").click()
        page.screenshot(path=FOLDER / "sunlight.png", full_page=True)
        accessibility(page, ["color-contrast-enhanced"])
        page.locator("#theme").click()

        asked("KILL")
        stale = "[...document.querySelectorAll('[data-group], #video-panel')].every((it) => it.classList.contains('stale'))"
        measured["grey_s"] = wait(page, stale, 5)
        accessibility(page, ["button-name"])
        assert page.locator("button[data-command=abort]").is_disabled(), "a button can be used without a connection"
        assert "was:" in text(page, "#phase"), text(page, "#phase")
        for selector in STATE_ELEMENTS:
            lines = page.evaluate(LINES, selector)
            assert lines and set(lines) == {"line-through"}, f"{selector} is not struck through: {lines}"
        time.sleep(1.5)
        for strip in page.locator(".strip:not(:last-child) p span:last-child").all_inner_texts():
            assert strip.startswith("- "), f"a number of long ago: {strip}"
        page.screenshot(path=FOLDER / "cut-off.png", full_page=True)
        asked("START")
        measured["back_s"] = wait(page, CONNECTED, 10)
        wait(page, "!document.getElementById('video-panel').classList.contains('stale')", 10)
        wait(page, "!document.querySelector('main').classList.contains('cut-off')", 2)

        press_space(page, "resume")
        wait(page, "['The autopilot lands', 'Touching down', 'Landed'].includes(document.getElementById('phase').textContent)")
        page.screenshot(path=FOLDER / "landed.png", full_page=True)
        browser.close()
    foreign = [url for url in requests if not url.startswith(URL)]
    assert not foreign, f"asked of others: {foreign}"
    # Failures while the server is away are no error of the page.
    problems = [it for it in problems if "ERR_CONNECTION" not in it and "WebSocket connection" not in it]
    assert not problems, problems
    print(json.dumps(measured))


main()
