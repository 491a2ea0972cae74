//! Numbers, tables and paragraphs in plain text.

use std::mem;

use rtnet::time::Span;

const UNITS: [(u64, &str); 3] = [(1_000_000_000, "s"), (1_000_000, "ms"), (1_000, "us")];

/// `240 000`.
pub(crate) fn grouped(count: u64) -> String {
    let digits = count.to_string();
    let mut text = String::with_capacity(digits.len() * 4 / 3);
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

/// Nanoseconds as microseconds without the unit, to about three digits: `-0.35`, `12.3`, `1 234`.
pub(crate) fn micros(ns: i64) -> String {
    let us = ns as f64 / 1e3;
    match ns.unsigned_abs() {
        0..10_000 => format!("{us:.2}"),
        10_000..100_000 => format!("{us:.1}"),
        long => format!("{}{}", if ns < 0 { "-" } else { "" }, grouped((long + 500) / 1000)),
    }
}

/// As [`micros`]; `-` if there is none.
pub(crate) fn micros_or_dash(ns: Option<i64>) -> String {
    ns.map_or_else(|| "-".to_owned(), micros)
}

/// A duration as it is written everywhere, all digits kept: `1ms`, `1.5ms`, `100ns`.
pub(crate) fn duration(ns: u64) -> String {
    Span::from_nanos(i64::try_from(ns).unwrap_or(i64::MAX)).to_string()
}

/// The same, to a tenth where it is a second and more: `9.9s`, `500ms`.
pub(crate) fn about(ns: u64) -> String {
    const SECOND: u64 = 1_000_000_000;
    const TENTH: u64 = SECOND / 10;
    duration(if ns < SECOND { ns } else { ns.saturating_add(TENTH / 2) / TENTH * TENTH })
}

/// Nanoseconds in the unit that suits, signed, to three digits: `+1.23ms`; `0` is without a unit.
pub(crate) fn signed_time(ns: i64) -> String {
    if ns == 0 {
        return "0".to_owned();
    }
    let (size, unit) = unit_for(ns.unsigned_abs());
    let value = ns as f64 / size as f64;
    let decimals = match value.abs() {
        0.0..10.0 => 2,
        10.0..100.0 => 1,
        _ => 0,
    };
    format!("{value:+.decimals$}{unit}")
}

fn unit_for(ns: u64) -> (u64, &'static str) {
    UNITS.into_iter().find(|&(size, _)| ns >= size).unwrap_or((1_000, "us"))
}

/// The text, or as much of it as fits, ending in dots.
pub(crate) fn cut(text: &str, width: usize) -> String {
    if text.chars().count() <= width {
        return text.to_owned();
    }
    text.chars().take(width.saturating_sub(3)).chain("...".chars()).collect()
}

/// A list after a label, broken between its items only; further lines stand below the first item.
pub(crate) fn list(label: &str, items: &[String], width: usize) -> Vec<String> {
    fill(label, items.iter().map(String::as_str), ", ", width)
}

/// Prose after a label, broken between words; further lines stand below the first word.
pub(crate) fn paragraph(label: &str, text: &str, width: usize) -> Vec<String> {
    fill(label, text.split_whitespace(), " ", width)
}

fn fill<'a>(label: &str, pieces: impl Iterator<Item = &'a str>, glue: &str, width: usize) -> Vec<String> {
    let indent = label.chars().count();
    let room = width.saturating_sub(indent).max(1);
    let mut rows = vec![String::new()];
    for piece in pieces {
        // One column is kept for a comma at the line's end.
        let piece = cut(piece, room - 1);
        let row = rows.last_mut().expect("never empty");
        let length = row.chars().count();
        if length == 0 {
            *row = piece;
        } else if length + glue.len() + piece.chars().count() < room {
            *row += &(glue.to_owned() + &piece);
        } else {
            *row += glue.trim_end();
            rows.push(piece);
        }
    }
    let mut label = label.to_owned();
    rows.into_iter().map(|row| mem::replace(&mut label, " ".repeat(indent)) + &row).collect()
}

/// A column of a [`table`].
pub(crate) struct Column {
    head: [&'static str; 2],
    cells: Vec<String>,
    left: bool,
}

impl Column {
    /// Aligned to the left: for names.
    pub(crate) fn left(head: [&'static str; 2], cells: impl Iterator<Item = String>) -> Self {
        Self { head, cells: cells.collect(), left: true }
    }

    /// Aligned to the right: for numbers.
    pub(crate) fn right(head: [&'static str; 2], cells: impl Iterator<Item = String>) -> Self {
        Self { head, cells: cells.collect(), left: false }
    }

    fn width(&self) -> usize {
        let cells = self.cells.iter().map(|cell| cell.chars().count());
        cells.chain(self.head.map(str::len)).max().unwrap_or(0)
    }

    /// The row's text, in the column's width; rows 0 and 1 are the head.
    fn padded(&self, row: usize) -> String {
        let text = if row < 2 { self.head[row] } else { &self.cells[row - 2] };
        let width = self.width();
        if self.left { format!("{text:<width$}") } else { format!("{text:>width$}") }
    }
}

/// Columns side by side. What does not fit the width follows below, the first column again before it.
pub(crate) fn table(columns: &[Column], width: usize) -> Vec<String> {
    let Some((names, figures)) = columns.split_first() else { return Vec::new() };
    let mut lines = Vec::new();
    let mut rest = figures;
    while !rest.is_empty() {
        let mut total = names.width();
        let fitting = rest.iter().take_while(|column| {
            total += 1 + column.width();
            total <= width
        });
        let (block, below) = rest.split_at(fitting.count().max(1));
        rest = below;
        for row in 0..names.cells.len() + 2 {
            let cells = block.iter().map(|column| column.padded(row));
            let line = cells.fold(names.padded(row), |line, cell| line + " " + &cell);
            // A table may have a head of one line.
            if row > 0 || !line.trim().is_empty() {
                lines.push(line.trim_end().to_owned());
            }
        }
    }
    lines
}

/// A share in words: `0.5 %`, `12 %`.
pub fn percent(ppm: u64) -> String {
    let digits = match ppm {
        0..1_000 => 4,
        1_000..10_000 => 2,
        _ => 1,
    };
    let text = format!("{:.digits$}", ppm as f64 / 1e4);
    format!("{} %", text.trim_end_matches('0').trim_end_matches('.'))
}
