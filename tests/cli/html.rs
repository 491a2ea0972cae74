//! The report as a page, in a browser that people have: nothing leaves it, nothing is wider than the window.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;
use tools::report::html::markup::escape;

use crate::host;
use crate::rtnet;

const BROWSERS: [&str; 3] = ["chromium", "chromium-browser", "google-chrome"];
/// A browser that takes longer hangs.
const WITHIN: Duration = Duration::from_secs(90);
/// What no request of a page itself has as its initiator.
const BY_THE_BROWSER: &str = "not an origin";

/// Told by a copy of a page to the one around it: how wide it is and how wide the window; what it has fetched; the smallest
/// letters; and where slots are drawn, as shares of the cycle.
const MEASURE: &str = r#"<script>
addEventListener("load", () => {
  const page = document.documentElement;
  const letters = [...document.querySelectorAll("main *")].filter(of => [...of.childNodes].some(n => n.nodeType == 3 && n.data.trim()));
  const slots = of => [...of.querySelectorAll("rect.slot")].map(slot => {
    const area = slot.ownerSVGElement.getBoundingClientRect();
    return [slot.dataset.slot, (slot.getBoundingClientRect().left - area.left) / area.width];
  });
  parent.postMessage(JSON.stringify({
    width: page.scrollWidth, window: innerWidth,
    fetched: performance.getEntriesByType("resource").map(of => of.name),
    smallest: Math.min(...letters.map(of => parseFloat(getComputedStyle(of).fontSize))),
    figures: [...document.querySelectorAll("figure")].map(slots),
  }), "*");
});
</script>"#;
const AROUND: &str = r#"<!doctype html><body style="margin:0"><pre id="told"></pre><script>
addEventListener("message", told => document.getElementById("told").textContent = told.data);
</script><iframe src="copy.html" style="border:0;width:WIDTHpx;height:1000px"></iframe>"#;

/// A browser without a window.
struct Browser {
    program: &'static str,
    directory: TempDir,
}

impl Browser {
    /// If there is one here.
    fn find(test: &str) -> Option<Self> {
        let is_there = |program: &&&str| {
            Command::new(program)
                .arg("--version")
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .status()
                .is_ok()
        };
        let program = BROWSERS.iter().find(is_there);
        if program.is_none() {
            host::skip(test, "needs chromium (apt-get install chromium)");
        }
        Some(Self { program: program?, directory: tempfile::tempdir().unwrap() })
    }

    /// Opens a page, and returns what it has printed. No name is resolved, so nothing could leave this host.
    fn open(&self, page: &Path, arguments: &[String]) -> String {
        let output = self.directory.path().join("output");
        let mut browser = Command::new(self.program)
            .args(["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run"])
            .args(["--disable-background-networking", "--disable-component-update"])
            .arg("--host-resolver-rules=MAP * ~NOTFOUND")
            .arg(format!("--user-data-dir={}", self.directory.path().join("user").display()))
            .args(arguments)
            .arg(format!("file://{}", page.display()))
            .stdout(fs::File::create(&output).unwrap())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let begun = Instant::now();
        while browser.try_wait().unwrap().is_none() {
            if begun.elapsed() > WITHIN {
                browser.kill().unwrap();
                browser.wait().unwrap();
                panic!("{} hangs at {}", self.program, page.display());
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        fs::read_to_string(output).unwrap()
    }

    /// Keeps a picture of a page.
    fn picture(&self, page: &Path, (width, height): (u32, u32), to: &Path, more: &[&str]) {
        let _ = fs::remove_file(to);
        let mut arguments =
            vec![format!("--window-size={width},{height}"), format!("--screenshot={}", to.display())];
        arguments.extend(more.iter().map(|&of| of.to_owned()));
        self.open(page, &arguments);
        let picture = fs::read(to).unwrap();
        let size = |at: usize| u32::from_be_bytes(*picture[at..].first_chunk().unwrap());
        assert_eq!((&picture[1..4], size(16), size(20)), (&b"PNG"[..], width, height));
    }

    /// What a page is like in a window of this width.
    fn measure(&self, page: &Path, width: u32) -> Value {
        let here = self.directory.path();
        let text = fs::read_to_string(page).unwrap();
        fs::write(here.join("copy.html"), text.replace("</body>", &(MEASURE.to_owned() + "</body>")))
            .unwrap();
        let around = here.join("around.html");
        fs::write(&around, AROUND.replace("WIDTH", &width.to_string())).unwrap();
        let told = self.open(&around, &["--dump-dom".into(), "--virtual-time-budget=10000".into()]);
        let told = told.split_once("id=\"told\">").and_then(|(_, rest)| rest.split_once("</pre>"));
        serde_json::from_str(told.unwrap().0).unwrap()
    }

    /// What a page has asked of a network: not what the browser does for itself.
    fn requests(&self, page: &Path) -> Vec<String> {
        let log = self.directory.path().join("net.json");
        self.picture(
            page,
            (800, 600),
            &self.directory.path().join("any.png"),
            &[&format!("--log-net-log={}", log.display())],
        );
        let log: Value = serde_json::from_str(&fs::read_to_string(log).unwrap()).unwrap();
        let of_page = |event: &Value| {
            let params = event.get("params")?;
            let is_own = params.get("initiator")?.as_str()? != BY_THE_BROWSER;
            Some(params.get("url")?.as_str()?.to_owned()).filter(|_| is_own)
        };
        log["events"].as_array().unwrap().iter().filter_map(of_page).collect()
    }
}

/// Where what a person may want to look at is kept.
fn kept(name: &str) -> PathBuf {
    let target = Path::new(env!("CARGO_BIN_EXE_rtnet")).ancestors().nth(2).unwrap();
    let directory = target.join("html-report");
    fs::create_dir_all(&directory).unwrap();
    directory.join(name)
}

fn simulated(file: &str, name: &str) -> PathBuf {
    let (page, here) = (kept(name), Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/cli"));
    let output = rtnet().args(["sim", "run"]).arg(here.join(file)).arg("--html").arg(&page).output();
    assert_eq!(output.unwrap().status.code(), Some(0));
    page
}

/// It does not scroll sideways, its letters can be read, and it fetches nothing; what it is like in a window of this width.
fn assert_is_readable(browser: &Browser, page: &Path, width: u32) -> Value {
    let told = browser.measure(page, width);
    assert_eq!(told["window"], width);
    assert!(told["width"].as_u64().unwrap() <= width.into(), "it scrolls sideways: {}", told["width"]);
    assert!(told["smallest"].as_f64().unwrap() >= 10.0, "letters too small: {}", told["smallest"]);
    assert_eq!(told["fetched"], serde_json::json!([]));
    told
}

#[test]
fn a_page_is_readable_in_a_browser_at_any_width_and_shows_the_slots_of_the_file() {
    let test = "a_page_is_readable_in_a_browser_at_any_width_and_shows_the_slots_of_the_file";
    let Some(browser) = Browser::find(test) else { return };
    let page = simulated("html.toml", "sim.html");
    for (width, height) in [(1_280, 3_600), (400, 5_600)] {
        browser.picture(&page, (width, height), &kept(&format!("sim-{width}.png")), &[]);
        let told = assert_is_readable(&browser, &page, width);
        let figures = told["figures"].as_array().unwrap();
        // The camera is stalled ten times. Outages of the other station add to these; the page shows twelve cycles at most.
        let (worst, ordinary) = (10..=12, 1);
        assert!(worst.contains(&(figures.len() - ordinary)), "{} cycles", figures.len());
        for figure in figures {
            shows_the_slots_of_the_file(figure);
        }
        host::figure(
            test,
            &format!("at {width} px wide {} px, letters of {} px", told["width"], told["smallest"]),
        );
    }
    let dark = ["--blink-settings=preferredColorScheme=0"];
    browser.picture(&page, (1_280, 3_600), &kept("sim-1280-dark.png"), &dark);
}

#[test]
fn the_page_of_a_ring_is_readable_in_a_browser_at_any_width_and_asks_nothing_of_any_network() {
    let test = "the_page_of_a_ring_is_readable_in_a_browser_at_any_width_and_asks_nothing_of_any_network";
    let Some(browser) = Browser::find(test) else { return };
    let page = simulated("plan.in/ring.toml", "ring.html");
    for (width, height) in [(1_280, 2_400), (400, 4_000)] {
        browser.picture(&page, (width, height), &kept(&format!("ring-{width}.png")), &[]);
        assert_is_readable(&browser, &page, width);
    }
    assert_eq!(browser.requests(&page), Vec::<String>::new());
}

/// As `html.toml` has them, in a cycle of 1 ms.
fn shows_the_slots_of_the_file(figure: &Value) {
    const LONG: &str = "a-station-with-the-longest-name1";
    let usual = [("master 0".to_owned(), 0.1), (format!("{LONG} 0"), 0.25), ("camera 0".to_owned(), 0.45)];
    let every_second = (format!("{LONG} 2"), 0.7);
    let drawn: Vec<(&str, f64)> = figure
        .as_array()
        .unwrap()
        .iter()
        .map(|slot| (slot[0].as_str().unwrap(), slot[1].as_f64().unwrap()))
        .collect();
    assert!([3, 4].contains(&drawn.len()), "{drawn:?}");
    for (name, at) in &usual {
        assert!(
            drawn.iter().any(|of| of.0 == name && (of.1 - at).abs() < 0.003),
            "{name} at {at}: {drawn:?}"
        );
    }
    if drawn.len() == 4 {
        let (name, at) = &every_second;
        assert!(
            drawn.iter().any(|of| of.0 == name && (of.1 - at).abs() < 0.003),
            "{name} at {at}: {drawn:?}"
        );
    }
}

#[test]
fn a_page_asks_nothing_of_any_network() {
    let Some(browser) = Browser::find("a_page_asks_nothing_of_any_network") else { return };
    let page = simulated("html.toml", "requests.html");
    assert_eq!(browser.requests(&page), Vec::<String>::new());
    // One that does is seen to.
    let asking = browser.directory.path().join("asking.html");
    let picture = "<main><img src=\"http://nowhere.invalid/a.png\">";
    fs::write(&asking, fs::read_to_string(&page).unwrap().replacen("<main>", picture, 1)).unwrap();
    let asked = browser.requests(&asking);
    assert!(asked.iter().any(|url| url == "http://nowhere.invalid/a.png"), "{asked:?}");
}

#[test]
fn a_live_lab_has_such_a_page_too() {
    host::shared("a_live_lab_has_such_a_page_too", || {
        let (page, report) = (kept("lab.html"), kept("lab.json"));
        let mut lab = rtnet();
        lab.args(["lab", "run", "--stations", "4", "--cycle", "4ms", "--duration", "2s"]);
        lab.arg("--html").arg(&page).arg("--json").arg(&report);
        let screen = String::from_utf8(lab.output().unwrap().stdout).unwrap();
        let html = fs::read_to_string(&page).unwrap();
        let report = crate::schema::read(fs::read(&report).unwrap());
        let (word, rest) = screen.lines().last().unwrap().split_once(": ").unwrap();
        assert!(html.contains(&format!("<strong>{word}</strong>")), "{screen}");
        // The screen shortens long reasons. A run that is OK has none.
        let reasons = report["verdict"]["reasons"].as_array().unwrap();
        let reasons: Vec<&str> = reasons.iter().map(|reason| reason.as_str().unwrap()).collect();
        for reason in if reasons.is_empty() { vec![rest] } else { reasons } {
            assert!(html.contains(&escape(reason)), "{reason} of {screen}");
        }
        for shown in
            ["live, network namespaces", "Linux ", "one bridge of the kernel", "<section id=\"sync\">"]
        {
            assert!(html.contains(shown), "no {shown}");
        }
        assert!(html.contains("data-slot=\"slave3 0\"") || html.matches("data-slot=\"").count() >= 4);
    });
}
