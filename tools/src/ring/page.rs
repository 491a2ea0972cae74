//! A ring's report as one page that needs nothing else: how long rounds take, the tables of the screen, the bounds, and the
//! indicators of IEC 61784-2. It has no slots to draw, and says so.

mod indicators;

use super::figures::RingFigures;
use super::screen::{counts, facts, kinds, notes_of, queueing_words, well, who, words};
use crate::report::histogram::SignedHistogram;
use crate::report::html::latency::{self, Plot};
use crate::report::html::markup::{Table, count, escape, section, us};
use crate::report::html::series::Series;
use crate::report::html::{shell, verdict};
use crate::report::screen::host_items;
use crate::report::text::signed_time;

/// The whole page, called so.
pub fn page(title: &str, figures: &RingFigures) -> String {
    let body = [
        head(title, figures),
        section("latency", "How long rounds of the token took", &rounds_note(figures), &rounds(figures)),
        section("times", "How long everything takes", LEFT_OUT, &times(figures)),
        section("stations", "Stations", "In the order in which the token goes round.", &stations(figures)),
        section("queueing", "What programs queued", &queued_note(figures), &queueing(figures)),
        section("misses", "The token lost and found", "The longest first.", &recoveries(figures)),
        indicators::html(figures),
        section("told", "What else there is to say", "", &listed(&notes_of(figures))),
        section("host", "Host", "", &listed(&host_items(&figures.host, None))),
    ];
    shell(title, &figures.verdict, &body.concat())
}

const LEFT_OUT: &str = "A ring has no slots and no master’s time: there is no slot error, no picture of cycles and no sync error here.";

/// How wide a bin of rounds is, so that one as long as may be is within the plot.
fn bin_us(figures: &RingFigures) -> i64 {
    latency::bin_for(figures.bounds.rotation_ns)
}

fn rounds_note(figures: &RingFigures) -> String {
    format!(
        "From one time that the token came to a station to the next, in bins of {} µs; {} µs at the most were promised where nothing is \
         lost. What lies beyond the axis is counted in the legend.",
        bin_us(figures),
        us(Some(figures.bounds.rotation_ns))
    )
}

fn rounds(figures: &RingFigures) -> String {
    let names: Vec<&str> = figures.per_station.iter().map(|of| of.name.as_str()).collect();
    let longest: Vec<i64> = figures.per_station.iter().map(|of| of.rotation_ns.max.unwrap_or(0)).collect();
    let times = &figures.kept.rotation;
    if times.iter().all(SignedHistogram::is_empty) {
        return "<p>No round was seen.</p>\n".into();
    }
    let plot = Plot { times, names: &names, bin_us: bin_us(figures), what: "rounds", measured: "round" };
    plot.html(&Series::of(&longest))
}

fn head(title: &str, figures: &RingFigures) -> String {
    let items: String = facts(figures).iter().map(|fact| format!("<li>{}</li>", escape(fact))).collect();
    let three = [
        (
            "Frames seen",
            count(figures.frames_seen),
            "",
            format!("{} lost on the way", count(figures.frames_lost)),
        ),
        (
            "Round of the token, max",
            us(figures.rotation_ns.max),
            " µs",
            format!(
                "median {} µs; bound {} µs",
                us(figures.rotation_ns.p50),
                us(Some(figures.bounds.rotation_ns))
            ),
        ),
        (
            "Recovery, max",
            us(figures.recovery_ns.max),
            " µs",
            format!(
                "{} times; bound {} µs with one station dead; {} unexplained",
                count(figures.recovery_ns.n),
                us(Some(figures.bounds.recovery_ns)),
                count(figures.unexplained)
            ),
        ),
    ];
    let three = three.map(|(name, value, unit, more)| {
        format!(
            "<div><dt>{name}</dt><dd>{value}<small>{unit}</small></dd><dd class=\"more\">{more}</dd></div>\n"
        )
    });
    format!(
        "<header>\n<h1>{}</h1>\n<ul class=\"facts\">{items}</ul>\n{}<dl class=\"three\">\n{}</dl>\n</header>\n",
        escape(title),
        verdict(&figures.verdict, &well(figures)),
        three.concat()
    )
}

fn times(figures: &RingFigures) -> String {
    let heads = ["times", "n", "gaps", "min µs", "p50 µs", "p99 µs", "p99.9 µs", "max µs", "bound µs"];
    let mut table = Table::new("", 1, &heads);
    let mut meanings = Table::new("", 2, &["times", "what it is"]).of_prose();
    for (name, what, of, bound) in kinds(figures) {
        let quantiles = [of.min, of.p50, of.p99, of.p999, of.max, bound].map(us);
        table.row(
            [name.to_owned(), count(of.n), of.gaps.map_or("–".into(), count)].into_iter().chain(quantiles),
        );
        meanings.row([name.to_owned(), escape(what)]);
    }
    let bounds = figures.bounds;
    for (name, ns, what) in [
        ("access delay", bounds.access_delay_ns, "the most urgent frame’s wait, at the most"),
        ("doubling", bounds.doubling_ns, "while two stations have a token each, at the most"),
        ("rejoin", bounds.rejoin_ns, "until one that is back has the token, at the most"),
    ] {
        meanings.row([name.to_owned(), format!("{} µs: {what}", us(Some(ns)))]);
    }
    table.html() + &meanings.html()
}

fn stations(figures: &RingFigures) -> String {
    let heads = [
        "station",
        "at the end",
        "clock offset",
        "drift ppm",
        "frames seen",
        "token came",
        "round p50 µs",
        "round max µs",
        "delivery max µs",
        "lost on the way",
    ];
    let mut table = Table::new("", 2, &heads);
    for of in &figures.per_station {
        table.row([
            escape(&of.name),
            escape(&of.state),
            signed_time(of.clock_offset_ns),
            format!("{:+.1}", of.clock_drift_ppb as f64 / 1e3),
            count(of.frames_seen),
            count(of.visits),
            us(of.rotation_ns.p50),
            us(of.rotation_ns.max),
            us(of.delivery_ns.max),
            count(of.frames_lost),
        ]);
    }
    table.html()
}

fn queued_note(figures: &RingFigures) -> String {
    if figures.queueing.is_empty() { String::new() } else { escape(&queueing_words(figures)) }
}

fn queueing(figures: &RingFigures) -> String {
    if figures.queueing.is_empty() {
        return "<p>Nothing but the usual frames.</p>\n".into();
    }
    let mut table = Table::new("", 1, &["priority", "n", "p50 µs", "p99 µs", "max µs", "refused"]);
    for of in &figures.queueing {
        let quantiles = [of.delay_ns.p50, of.delay_ns.p99, of.delay_ns.max].map(us);
        let head = [of.priority.to_string(), count(of.frames_seen)];
        table.row(head.into_iter().chain(quantiles).chain([count(of.refused)]));
    }
    table.html()
}

fn recoveries(figures: &RingFigures) -> String {
    let counted: Vec<String> =
        counts(figures).iter().map(|(n, what)| format!("{what}: {}", count(*n))).collect();
    let mut table = Table::new("", 1, &["whose token", "at ms", "took µs", "bound µs", "cause"]);
    for of in &figures.recoveries {
        table.row([
            escape(&who(of)),
            format!("{:.3}", of.at_ns as f64 / 1e6),
            us(Some(of.took_ns)),
            us(Some(of.bound_ns)),
            words(of.cause),
        ]);
    }
    listed(&counted) + &table.html()
}

fn listed(items: &[String]) -> String {
    if items.is_empty() {
        return "<p>Nothing.</p>\n".into();
    }
    let items: String = items.iter().map(|item| format!("<li>{}</li>", escape(item))).collect();
    format!("<ul>{items}</ul>\n")
}
