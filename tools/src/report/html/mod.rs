//! The report as one page that needs nothing else: no script, no font, no picture from anywhere. Pure: of the same run the
//! same bytes.
//!
//! ```text
//!   verdict, the three figures that matter ─► latency plot ─► slots of captured cycles ─► clocks ─► tables ─► host
//! ```

mod causes;
mod chart;
mod gantt;
pub mod indicators;
pub mod latency;
pub mod markup;
mod scale;
pub mod series;
mod sync;
mod tables;
#[cfg(test)]
mod tests;

use crate::judge::kept::Kept;
use crate::report::figures::Figures;
use crate::report::screen;
use crate::report::text::{about, duration};
use crate::report::verdict::Verdict;
use crate::scenario::Scenario;
use crate::sim::Simulation;

use markup::{count, escape, of, us};
use series::Series;

/// What a page is made of.
pub struct Sheet<'a> {
    /// What was run: the scenario's file, if it has one.
    pub title: &'a str,
    /// What was to be.
    pub scenario: &'a Scenario,
    /// What was.
    pub figures: &'a Figures,
    /// What its pictures show.
    pub kept: &'a Kept,
    /// What only a run in virtual time has.
    pub simulation: Option<&'a Simulation>,
}

/// A page with this body, which is HTML.
pub fn shell(title: &str, verdict: &Verdict, body: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n\
         <title>{}: {}</title>\n<style>\n{}</style>\n</head>\n<body>\n<main>\n{body}</main>\n</body>\n</html>\n",
        escape(title),
        verdict.word.name(),
        include_str!("style.css"),
    )
}

/// The word, and its reasons; or what an OK run has shown.
pub fn verdict(verdict: &Verdict, well: &str) -> String {
    let rest = match &verdict.reasons[..] {
        [] => escape(well),
        [why] => escape(why),
        many => {
            let reasons = many.iter().map(|reason| format!("<li>{}</li>", escape(reason)));
            format!("<ul>{}</ul>", reasons.collect::<String>())
        }
    };
    let (class, word) = (verdict.word.class(), verdict.word.name());
    format!("<div class=\"verdict {class}\"><strong>{word}</strong> <div>{rest}</div></div>\n")
}

impl Sheet<'_> {
    /// The whole page.
    pub fn page(&self) -> String {
        let worst = |of: &crate::report::figures::StationFigures| of.slot_error_ns.max.unwrap_or(0);
        let series = Series::of(&self.figures.per_station.iter().map(worst).collect::<Vec<_>>());
        let body = [
            self.head(),
            latency::html(self, &series),
            gantt::html(self),
            sync::html(self, &series),
            tables::stations(self),
            tables::jitter(self),
            causes::html(self),
            causes::expected(self),
            indicators::html(self),
            causes::told(self),
            tables::host(self),
        ];
        shell(self.title, &self.figures.verdict, &body.concat())
    }

    /// A station's name.
    fn name(&self, station: usize) -> &str {
        self.scenario.stations.get(station).map_or("foreign", |plan| &plan.name)
    }

    /// What it was, how it went, and the three figures that matter.
    fn head(&self) -> String {
        let Self { figures, simulation, .. } = self;
        let measured = about(figures.cycles.saturating_mul(figures.cycle_ns));
        let world = match simulation {
            Some(simulation) => format!("virtual time, seed {}", simulation.seed),
            None => "live, network namespaces".into(),
        };
        let facts = [
            format!("{} stations", count(figures.stations)),
            format!("cycle {}", duration(figures.cycle_ns)),
            format!("{} cycles, {measured}", count(figures.cycles)),
            world,
        ];
        let facts: String = facts.iter().map(|fact| format!("<li>{fact}</li>")).collect();
        format!(
            "<header>\n<h1>{}</h1>\n<ul class=\"facts\">{facts}</ul>\n{}{}</header>\n",
            escape(self.title),
            verdict(&self.figures.verdict, &screen::well(self.figures)),
            self.three(),
        )
    }

    fn three(&self) -> String {
        let Figures { frames_seen, frames_expected, slots_missed, slot_error_ns, sync_error_abs_ns, .. } =
            self.figures;
        let outside = self.figures.out_of_slot + self.figures.overlaps;
        let figure = |name: &str, value: String, unit: &str, more: String| {
            format!(
                "<div><dt>{name}</dt><dd>{value}<small>{unit}</small></dd><dd class=\"more\">{more}</dd></div>\n"
            )
        };
        let missed = format!(
            "{} missed, {} outside their slot or overlapping, {} unexplained",
            count(*slots_missed),
            count(outside),
            count(self.figures.unexplained)
        );
        let p = |of: Option<i64>| us(of) + " µs";
        [
            "<dl class=\"three\">\n".to_owned(),
            figure("Frames seen of those expected", of(*frames_seen, *frames_expected), "", missed),
            figure(
                "Slot error, max",
                us(slot_error_ns.max),
                " µs",
                format!("p99.9 {}, median {}", p(slot_error_ns.p999), p(slot_error_ns.p50)),
            ),
            figure(
                "|Sync error|, max",
                us(sync_error_abs_ns.max),
                " µs",
                format!("p99.9 {}, median {}", p(sync_error_abs_ns.p999), p(sync_error_abs_ns.p50)),
            ),
            "</dl>\n".to_owned(),
        ]
        .concat()
    }
}
