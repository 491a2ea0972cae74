//! JUnit's XML, which services that run tests show.
//!
//! ```xml
//! <testsuites name="..." tests="3" failures="1" skipped="1">
//!   <testsuite name="FILE" tests="3" failures="1" skipped="1">
//!     <testcase classname="FILE" name="seed 1"/>
//!     <testcase classname="FILE" name="seed 2"><failure message="...">...</failure></testcase>
//!     <testcase classname="FILE" name="seed 3"><skipped message="..."/></testcase>
//! ```

use std::fmt::Write;

use super::html::markup::escape;

/// Cases that belong together.
#[derive(Clone, Debug)]
pub struct Suite {
    /// Its name, which is its cases' class, too.
    pub name: String,
    /// The cases.
    pub cases: Vec<Case>,
}

/// Something that was tried.
#[derive(Clone, Debug)]
pub struct Case {
    /// Unique in its suite.
    pub name: String,
    /// What came of it.
    pub outcome: Outcome,
}

/// What came of a case.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It is as it should be.
    Passed,
    /// It is not, for these reasons, of which the first is shown first; and the command that shows it.
    Failed(Vec<String>, String),
    /// It was not tried, for this reason.
    Skipped(String),
}

/// All of it as XML.
pub fn render(name: &str, suites: &[Suite]) -> String {
    let all = suites.iter().flat_map(|suite| &suite.cases);
    let mut xml = format!("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<testsuites{}>\n", head(name, all));
    for suite in suites {
        let _ = writeln!(xml, "  <testsuite{}>", head(&suite.name, suite.cases.iter()));
        suite.cases.iter().for_each(|case| xml += &of_case(&suite.name, case));
        xml += "  </testsuite>\n";
    }
    xml + "</testsuites>\n"
}

fn head<'a>(name: &str, cases: impl Iterator<Item = &'a Case> + Clone) -> String {
    let number = |is: fn(&Outcome) -> bool| cases.clone().filter(|case| is(&case.outcome)).count();
    format!(
        " name=\"{}\" tests=\"{}\" failures=\"{}\" skipped=\"{}\"",
        text(name),
        number(|_| true),
        number(|outcome| matches!(outcome, Outcome::Failed(..))),
        number(|outcome| matches!(outcome, Outcome::Skipped(_)))
    )
}

fn of_case(class: &str, case: &Case) -> String {
    let begin = format!("    <testcase classname=\"{}\" name=\"{}\"", text(class), text(&case.name));
    match &case.outcome {
        Outcome::Passed => format!("{begin}/>\n"),
        Outcome::Skipped(why) => format!("{begin}><skipped message=\"{}\"/></testcase>\n", text(why)),
        Outcome::Failed(reasons, command) => {
            let first = reasons.first().map_or("", String::as_str);
            let all = text(&format!("{}\n$ {command}", reasons.join("\n")));
            format!("{begin}><failure message=\"{}\">{all}</failure></testcase>\n", text(first))
        }
    }
}

/// Markup escaped, and without the characters that XML has no way to write.
fn text(text: &str) -> String {
    let is_legal =
        |c: char| (c >= ' ' || matches!(c, '\t' | '\n' | '\r')) && !matches!(c, '\u{fffe}' | '\u{ffff}');
    escape(&text.chars().map(|c| if is_legal(c) { c } else { '\u{fffd}' }).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failed_and_skipped_cases_are_counted_and_escaped() {
        let case = |name: &str, outcome| Case { name: name.into(), outcome };
        let failed = Outcome::Failed(vec!["a < b & \u{c}\u{1}c".into(), "\"d\"".into()], "rtnet x".into());
        let cases = vec![
            case("seed 1", Outcome::Passed),
            case("seed 2", failed),
            case("seed 3", Outcome::Skipped("no time".into())),
        ];
        let suites =
            [Suite { name: "<a>.toml".into(), cases }, Suite { name: "b".into(), cases: Vec::new() }];
        assert_eq!(
            render("rtnet", &suites),
            r#"<?xml version="1.0" encoding="UTF-8"?>
<testsuites name="rtnet" tests="3" failures="1" skipped="1">
  <testsuite name="&lt;a&gt;.toml" tests="3" failures="1" skipped="1">
    <testcase classname="&lt;a&gt;.toml" name="seed 1"/>
    <testcase classname="&lt;a&gt;.toml" name="seed 2"><failure message="a &lt; b &amp; ��c">a &lt; b &amp; ��c
&quot;d&quot;
$ rtnet x</failure></testcase>
    <testcase classname="&lt;a&gt;.toml" name="seed 3"><skipped message="no time"/></testcase>
  </testsuite>
  <testsuite name="b" tests="0" failures="0" skipped="0">
  </testsuite>
</testsuites>
"#
        );
    }
}
