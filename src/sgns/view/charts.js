// Numbers as text, and charts through time.

export const COLOURS = ["#1a1a1a", "#0072b2", "#d55e00"]; // of curves: told apart by every eye

// A number with so many digits, never as a power of ten.
export function number(value, digits = 3) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value), after = size < 1e-9 ? 0 : digits - 1 - Math.floor(Math.log10(size));
  const text = value.toFixed(Math.max(0, Math.min(after, 6)));
  return text.replace("-", "−").replace(/^−(0\.?0*)$/, "$1");
}

// A number that may reach `size`, with so many digits behind the point that the third one of that is seen.
export function fixed(value, size) {
  const text = value.toFixed(Math.max(0, 2 - Math.floor(Math.log10(Math.max(size, 1e-3)))));
  return text.replace("-", "−").replace(/^−(0\.?0*)$/, "$1");
}

// A chart is { canvas, names, curves }, each curve a list of { t, v, s }: time, value, half the width of a band or NaN.
// `mark` is a time to be marked.
export function paint(chart, from, to, mark = null) {
  const { canvas } = chart, scale = Math.min(window.devicePixelRatio || 1, 2);
  const wide = canvas.clientWidth, high = canvas.clientHeight;
  if (canvas.width !== Math.round(wide * scale)) {
    canvas.width = Math.round(wide * scale);
    canvas.height = Math.round(high * scale);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, wide, high);
  let low = 0, high_ = 1e-6;
  const seen = (one) => one.t >= from && one.t <= to && Number.isFinite(one.v);
  for (const curve of chart.curves)
    for (const one of curve) if (seen(one)) {
      const half = Number.isFinite(one.s) ? one.s : 0;
      low = Math.min(low, one.v - half);
      high_ = Math.max(high_, one.v + half);
    }
  const room = 0.06 * (high_ - low), step = nice((high_ - low) / 3), left = 46, below = 17;
  [low, high_] = [low - (low < 0 ? room : 0), high_ + room];
  const x = (t) => left + ((t - from) / (to - from)) * (wide - left - 2);
  const y = (v) => high - below - ((v - low) / (high_ - low)) * (high - below - 4);
  pen.font = '11px system-ui, "DejaVu Sans", sans-serif';
  pen.fillStyle = "#6b675e";
  pen.strokeStyle = "#e4e0d6";
  pen.lineWidth = 1;
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  for (let v = Math.ceil(low / step) * step; v <= high_; v += step) {
    const at = Math.round(y(v)) + 0.5;
    pen.beginPath();
    pen.moveTo(left, at);
    pen.lineTo(wide, at);
    pen.stroke();
    pen.fillText(number(Math.abs(v) < 1e-9 * step ? 0 : v, 2), left - 6, at);
  }
  pen.textBaseline = "alphabetic";
  pen.textAlign = "left";
  pen.fillText(`${number(from, 3)} s`, left, high - 3);
  pen.textAlign = "right";
  pen.fillText(`${number(to, 3)} s`, wide - 1, high - 3);
  chart.curves.forEach((curve, i) => {
    const shown = curve.filter(seen), colour = chart.paints?.[i] ?? COLOURS[i];
    if (shown.some((one) => Number.isFinite(one.s))) {
      pen.fillStyle = `${colour}2e`;
      pen.beginPath();
      for (const one of shown) pen.lineTo(x(one.t), y(one.v + one.s));
      for (const one of shown.toReversed()) pen.lineTo(x(one.t), y(one.v - one.s));
      pen.fill();
    }
    pen.strokeStyle = colour;
    pen.lineWidth = 1.6;
    pen.setLineDash(chart.dashes?.[i] ?? []);
    pen.beginPath();
    for (const one of shown) pen.lineTo(x(one.t), y(one.v));
    pen.stroke();
    pen.setLineDash([]);
  });
  if (mark !== null) {
    pen.strokeStyle = "#6b675e";
    pen.lineWidth = 1;
    pen.beginPath();
    pen.moveTo(x(mark), 0);
    pen.lineTo(x(mark), high - below);
    pen.stroke();
  }
}

function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [1, 2, 5, 10].find((step) => step * power >= value * (1 - 1e-9));
}
