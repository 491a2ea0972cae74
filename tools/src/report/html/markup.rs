//! Text as HTML and SVG take it.

use crate::report::text::{grouped, micros};

/// A text that may stand in an element or in an attribute, whatever is in it.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            // Others may not stand in a page at all.
            c if c.is_control() && !c.is_whitespace() => escaped.push('\u{fffd}'),
            c => escaped.push(c),
        }
    }
    escaped
}

/// A section of the page: its head, a sentence of what it shows, which is HTML, and what that is.
pub fn section(id: &str, head: &str, note: &str, body: &str) -> String {
    let note = if note.is_empty() { String::new() } else { format!("<p class=\"note\">{note}</p>\n") };
    format!("<section id=\"{id}\">\n<h2>{head}</h2>\n{note}{body}</section>\n")
}

/// A table in a box of its own, which scrolls sideways where the page is too narrow. Cells are HTML; the first column is a head.
pub struct Table {
    caption: String,
    heads: Vec<&'static str>,
    rows: String,
    /// So many of the first columns are text, all others are numbers.
    texts: usize,
    class: &'static str,
}

impl Table {
    /// With these heads, of which so many are of text, not numbers.
    pub fn new(caption: impl Into<String>, texts: usize, heads: &[&'static str]) -> Self {
        Self { caption: caption.into(), heads: heads.to_vec(), rows: String::new(), texts, class: "" }
    }

    /// Whose texts are sentences, and break.
    pub fn of_prose(self) -> Self {
        Self { class: " class=\"prose\"", ..self }
    }

    /// Adds a row.
    pub fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.row_of("", cells);
    }

    /// Adds a row with a class of its own.
    pub fn row_of(&mut self, class: &str, cells: impl IntoIterator<Item = String>) {
        let class = if class.is_empty() { String::new() } else { format!(" class=\"{class}\"") };
        self.rows += &format!("<tr{class}>");
        for (i, cell) in cells.into_iter().enumerate() {
            self.rows += &match i {
                0 => format!("<th scope=\"row\">{cell}</th>"),
                _ if i < self.texts => format!("<td class=\"text\">{cell}</td>"),
                _ => format!("<td>{cell}</td>"),
            };
        }
        self.rows += "</tr>\n";
    }

    /// The whole; nothing if it has no rows.
    pub fn html(&self) -> String {
        if self.rows.is_empty() {
            return String::new();
        }
        let head = |(i, head): (usize, &&str)| {
            let class = if i < self.texts { " class=\"text\"" } else { "" };
            format!("<th scope=\"col\"{class}>{head}</th>")
        };
        let heads: String = self.heads.iter().enumerate().map(head).collect();
        let caption = match self.caption.as_str() {
            "" => String::new(),
            caption => format!("<caption>{caption}</caption>"),
        };
        format!(
            "<div class=\"scroll\" tabindex=\"0\"><table{}>{caption}<thead><tr>{heads}</tr></thead>\n<tbody>\n{}</tbody></table></div>\n",
            self.class, self.rows
        )
    }
}

/// A count, grouped so that it does not break.
pub fn count(n: u64) -> String {
    grouped(n).replace(' ', "\u{2009}")
}

/// A share of a whole.
pub fn of(part: u64, whole: u64) -> String {
    format!("{}/{}", count(part), count(whole))
}

/// Nanoseconds in microseconds, without the unit; a dash if there is none.
pub fn us(ns: Option<i64>) -> String {
    let text = |ns| {
        let text = micros(ns);
        let is_zero = !text.contains(|c: char| ('1'..='9').contains(&c));
        text.replace('-', if is_zero { "" } else { "−" }).replace(' ', "\u{2009}")
    };
    ns.map_or_else(|| "–".into(), text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_name_is_markup() {
        assert_eq!(escape(r#"<a b="c" d='e'>&amp;"#), "&lt;a b=&quot;c&quot; d=&#39;e&#39;&gt;&amp;amp;");
        assert_eq!(escape("µs\u{0}\u{1b}\n"), "µs\u{fffd}\u{fffd}\n");
    }

    #[test]
    fn a_table_has_heads_that_stay_and_a_box_that_scrolls() {
        let mut table = Table::new("what", 2, &["station", "role", "n"]);
        assert_eq!(table.html(), "");
        table.row(["a", "slave", "1"].map(str::to_owned));
        let html = table.html();
        assert!(html.starts_with("<div class=\"scroll\""), "{html}");
        let row = "<tr><th scope=\"row\">a</th><td class=\"text\">slave</td><td>1</td></tr>";
        assert!(html.contains(row), "{html}");
    }

    #[test]
    fn numbers_do_not_break_and_a_minus_is_one() {
        assert_eq!((us(Some(-4)), us(Some(-5_001))), ("0.00".into(), "−5.00".into()));
        assert_eq!(
            (count(1_234_567), us(Some(-1_234_567)), us(None)),
            ("1\u{2009}234\u{2009}567".into(), "−1\u{2009}235".into(), "–".into())
        );
    }
}
