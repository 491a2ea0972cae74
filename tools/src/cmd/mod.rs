//! One module per verb: from arguments to the thing done.

pub mod lab;
pub mod lab_run;
pub mod lab_up;
pub mod manual;
pub mod slot;
pub mod station;
pub mod tdma;

/// Whose fault a failure is, which the exit status tells.
#[derive(Debug)]
pub enum Failure {
    /// Bad usage or configuration, or a host that does not let us: status 2.
    Usage(anyhow::Error),
    /// It ran, and something was not as it should be: status 1.
    Run(anyhow::Error),
}

impl Failure {
    /// The process's exit status.
    pub fn status(&self) -> u8 {
        match self {
            Failure::Usage(_) => 2,
            Failure::Run(_) => 1,
        }
    }
    /// What to tell the user.
    pub fn error(&self) -> &anyhow::Error {
        match self {
            Failure::Usage(error) | Failure::Run(error) => error,
        }
    }
}

/// Prints something as JSON or in words. Whoever closed our output does not want to read the rest.
fn print<T: serde::Serialize>(json: bool, what: &T, words: impl Fn(&T) -> String) -> anyhow::Result<()> {
    let text = if json { serde_json::to_string_pretty(what)? + "\n" } else { words(what) };
    let _ = std::io::Write::write_all(&mut std::io::stdout(), text.as_bytes());
    Ok(())
}
