//! What a run comes to: one word, its reasons, and one exit status, the same on the screen, in JSON, on the page and in `lab status`.

use serde::{Deserialize, Serialize};

use super::text::{cut, paragraph};

/// What a run comes to, the best first.
#[derive(Clone, Copy, Debug, Default, Deserialize, Eq, Ord, PartialEq, PartialOrd, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Word {
    /// It kept what it promises.
    #[default]
    Ok,
    /// Less came than was asked for, and every loss has a known cause.
    Degraded,
    /// Nothing follows: the host was too disturbed, or nothing is known of what happened.
    Inconclusive,
    /// It did not keep what it promises.
    NotOk,
    /// Somebody ended it before its time.
    Interrupted,
}

/// It was ended before there was anything to report.
#[derive(Debug, thiserror::Error)]
#[error("INTERRUPTED before anything was measured: {0}")]
pub struct Interrupted(pub(crate) String);

impl Word {
    /// Every one.
    pub const ALL: [Word; 5] = [Word::Ok, Word::Degraded, Word::Inconclusive, Word::NotOk, Word::Interrupted];

    /// The process's exit status. 2 is bad usage, which no run has.
    pub const fn exit_status(self) -> u8 {
        match self {
            Word::Ok => 0,
            Word::NotOk => 1,
            Word::Inconclusive => 3,
            Word::Degraded => 4,
            Word::Interrupted => 130,
        }
    }

    /// As a line begins with it.
    pub const fn name(self) -> &'static str {
        match self {
            Word::Ok => "OK",
            Word::Degraded => "DEGRADED",
            Word::Inconclusive => "INCONCLUSIVE",
            Word::NotOk => "NOT OK",
            Word::Interrupted => "INTERRUPTED",
        }
    }

    /// The class of its box on a page.
    pub const fn class(self) -> &'static str {
        match self {
            Word::Ok => "ok",
            Word::NotOk => "bad",
            Word::Degraded | Word::Inconclusive | Word::Interrupted => "unsure",
        }
    }
}

/// What a run comes to, and why.
#[derive(Clone, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
pub struct Verdict {
    /// Whether the word is OK.
    pub ok: bool,
    /// The word.
    pub word: Word,
    /// Why it is no better; a sentence each, without a full stop. The first says most.
    pub reasons: Vec<String>,
}

impl Default for Verdict {
    fn default() -> Self {
        Self::new(Word::Ok, Vec::new())
    }
}

impl Verdict {
    /// This one.
    pub fn new(word: Word, reasons: Vec<String>) -> Self {
        Self { ok: word == Word::Ok, word, reasons }
    }

    /// See [`Word::exit_status`].
    pub const fn exit_status(&self) -> u8 {
        self.word.exit_status()
    }

    /// In one line, however long; `well` says what an OK run has shown.
    pub fn line(&self, well: &str) -> String {
        match self.word {
            Word::Ok => format!("OK: {well}"),
            // Its first reason is after how long.
            Word::Interrupted => format!("{} {}", self.word.name(), self.reasons.join("; ")),
            _ => format!("{}: {}", self.word.name(), self.reasons.join("; ")),
        }
    }

    /// Its last line says it all; reasons that do not fit that line stand above it, and it begins with the first.
    pub fn lines(&self, well: &str, width: usize) -> Vec<String> {
        let in_one = self.line(well);
        if self.ok || in_one.chars().count() <= width {
            return vec![cut(&in_one, width)];
        }
        let mut lines: Vec<_> =
            self.reasons.iter().flat_map(|reason| paragraph("- ", reason, width)).collect();
        let more = match self.reasons.len() {
            1 => String::new(),
            n => format!(" ({} reasons, above)", n),
        };
        let room = width - more.chars().count();
        lines.push(cut(&in_one, room) + &more);
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_word_has_its_exit_status() {
        let all = Word::ALL.map(|word| (word.name(), word.exit_status()));
        assert_eq!(
            all,
            [("OK", 0), ("DEGRADED", 4), ("INCONCLUSIVE", 3), ("NOT OK", 1), ("INTERRUPTED", 130)]
        );
    }

    #[test]
    fn json_names_the_word_and_keeps_ok() {
        for (word, name) in [(Word::Ok, "ok"), (Word::NotOk, "not_ok"), (Word::Degraded, "degraded")] {
            let json = serde_json::to_value(Verdict::new(word, Vec::new())).unwrap();
            assert_eq!(json, serde_json::json!({ "ok": word == Word::Ok, "word": name, "reasons": [] }));
        }
    }

    #[test]
    fn line_begins_with_the_word_and_has_the_reasons() {
        let line = |word, reasons: &[&str]| {
            Verdict::new(word, reasons.iter().map(|&why| why.into()).collect()).line("all seen")
        };
        assert_eq!(line(Word::Ok, &[]), "OK: all seen");
        assert_eq!(line(Word::NotOk, &["1 unexplained miss", "b"]), "NOT OK: 1 unexplained miss; b");
        assert_eq!(line(Word::Interrupted, &["after 3s of 60s"]), "INTERRUPTED after 3s of 60s");
    }

    #[test]
    fn last_line_has_the_first_reason_where_not_all_have_room() {
        let long = Verdict::new(Word::Degraded, vec!["a reason of five words".into(); 8]);
        let lines = long.lines("", 80);
        assert_eq!(lines.len(), 9);
        assert!(lines[8].starts_with("DEGRADED: a reason of five words"), "{lines:?}");
        assert!(lines[8].ends_with(" (8 reasons, above)") && lines[8].chars().count() <= 80, "{lines:?}");
    }
}
