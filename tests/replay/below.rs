//! The line below Synchronisations, by its rule and the slow way: every pair of early ones is tried.

/// A window has as many Synchronisations of 100 ms as two seconds hold.
const WINDOW: usize = 20;
/// Its early one has an eighth of them before it.
const BEFORE_EARLY: usize = WINDOW / 8;
/// Fewer windows show no line.
const WINDOWS_AT_LEAST: usize = 8;
/// Largest drift of two clocks: 200 ppm of a cycle of 100 ms, in nanoseconds a cycle.
const FASTEST: f64 = 20_000.0;

/// A Synchronisation: its cycle, and by how much it is later than a line without drift, in nanoseconds.
type Point = (i64, i64);

/// The rule, from one beginning of the line to the next.
#[derive(Clone, Default)]
pub struct Below {
    window: Vec<Point>,
    early: Vec<Point>,
    edge: Option<(Point, Point)>,
}

impl Below {
    /// One more, of the line.
    pub fn note(&mut self, point: Point) {
        self.window.push(point);
        if self.window.len() < WINDOW {
            return;
        }
        // In whole nanoseconds; of two that are equally early it is the one that the same selection gives.
        let begin = self.window[0].0;
        let along = self.edge.or_else(|| edge_below_the_middle(&self.window).filter(clocks_may));
        let gained =
            |cycle| along.map_or(0, |(from, to)| (to.1 - from.1) * (cycle - begin) / (to.0 - from.0));
        let mut late: Vec<(i64, Point)> =
            self.window.iter().map(|&point| (point.1 - self.window[0].1 - gained(point.0), point)).collect();
        self.early.push(late.select_nth_unstable_by_key(BEFORE_EARLY, |&(late, _)| late).1.1);
        self.window.clear();
        if self.early.len() >= WINDOWS_AT_LEAST {
            self.edge = edge_below_the_middle(&self.early);
        }
    }

    /// How fast it is known to become later: nanoseconds a cycle.
    pub fn drift(&self) -> f64 {
        self.edge.map_or(0.0, slope)
    }

    /// Where the line is in a cycle, once there is one.
    pub fn at(&self, cycle: i64) -> Option<f64> {
        self.edge.map(|edge| on(edge, cycle))
    }
}

/// Whether two clocks can have this drift.
fn clocks_may(edge: &(Point, Point)) -> bool {
    slope(*edge).abs() <= FASTEST
}

fn slope((from, to): (Point, Point)) -> f64 {
    (to.1 - from.1) as f64 / (to.0 - from.0) as f64
}

fn on(edge: (Point, Point), cycle: i64) -> f64 {
    edge.1.1 as f64 + slope(edge) * (cycle - edge.1.0) as f64
}

/// From the earlier half to the later one so that nothing lies below.
fn edge_below_the_middle(early: &[Point]) -> Option<(Point, Point)> {
    let middle = early[0].0 + (early[early.len() - 1].0 - early[0].0) / 2;
    let (earlier, later): (Vec<Point>, Vec<Point>) = early.iter().partition(|&&(cycle, _)| cycle <= middle);
    let mut pairs = earlier.iter().flat_map(|&from| later.iter().map(move |&to| (from, to)));
    pairs.find(|&edge| early.iter().all(|&(cycle, late)| late as f64 >= on(edge, cycle) - 0.001))
}
