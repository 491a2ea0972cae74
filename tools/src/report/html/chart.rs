//! A plot that is as wide as there is room: curves stretch, text does not.

use std::fmt::Write;

/// What is around and behind the curves.
pub struct Chart<'a> {
    /// What is shown, for who cannot see it.
    pub label: &'a str,
    /// Height of the area, in pixels.
    pub height: u32,
    /// How far below the top there is a line, and what it says.
    pub y: Vec<(f64, String)>,
    /// Where from the left there is one, in per cent, and what it says.
    pub x: Vec<(f64, String)>,
    /// What the values up are, in which unit.
    pub y_title: &'a str,
    /// The same of those to the right.
    pub x_title: &'a str,
}

impl Chart<'_> {
    /// With curves that are drawn in so many units of width, and the chart's height.
    pub fn html(&self, width: f64, curves: &str) -> String {
        let &Self { label, height, ref y, ref x, y_title, x_title } = self;
        let mut lines = String::new();
        let mut y_labels = String::new();
        for (at, text) in y {
            let _ =
                write!(lines, "<line class=\"grid\" x1=\"0\" x2=\"100%\" y1=\"{at:.1}\" y2=\"{at:.1}\"/>");
            let _ = write!(
                y_labels,
                "<text x=\"100%\" dx=\"-6\" y=\"{:.1}\" text-anchor=\"end\">{text}</text>",
                at + 4.0
            );
        }
        let mut x_labels = String::new();
        for (at, text) in x {
            let _ = write!(
                lines,
                "<line class=\"grid\" x1=\"{at:.3}%\" x2=\"{at:.3}%\" y1=\"0\" y2=\"{height}\"/>"
            );
            let _ = write!(x_labels, "<text x=\"{at:.3}%\" y=\"14\" text-anchor=\"middle\">{text}</text>");
        }
        format!(
            "<div class=\"chart\">\n\
             <div class=\"y-title\">{y_title}</div>\n\
             <svg class=\"y\" width=\"100%\" height=\"{height}\" aria-hidden=\"true\">{y_labels}</svg>\n\
             <svg class=\"area\" width=\"100%\" height=\"{height}\" role=\"img\" aria-label=\"{label}\">{lines}\n\
             <svg width=\"100%\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" preserveAspectRatio=\"none\">\n{curves}</svg></svg>\n\
             <svg class=\"x\" width=\"100%\" height=\"18\" aria-hidden=\"true\">{x_labels}</svg>\n\
             <div class=\"x-title\">{x_title}</div>\n\
             </div>\n"
        )
    }
}
