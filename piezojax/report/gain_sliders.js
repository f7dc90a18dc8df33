// Show the step and the figures of the gains of the sliders, as in GainSurrogate.at.

const place = sliders.map((slider) => slider.value)
const functions = centres.map((centre) =>
  Math.hypot(...centre.map((value, index) => value - place[index])) ** 5)
functions.push(1, ...place)
const output = (index) =>
  functions.reduce((sum, value, row) => sum + value * weights[row * outputs + index], 0)

let first = 0
const coefficients = components.map((count) =>
  Array.from({ length: count }, () => output(first++)))
const step = coefficients.pop()
const errors = coefficients.map((each) => 1e3 * Math.hypot(...each))
const mean = Math.exp(errors.reduce((sum, value) => sum + Math.log(value), 0) / errors.length)
const margins = Array.from({ length: outputs - first }, () => output(first++))

const samples = basis.length / step.length
shown.data = {
  time: shown.data.time,
  displacement: Array.from({ length: samples }, (_, sample) =>
    step.reduce((sum, value, row) => sum + value * basis[row * samples + sample], 0)),
}
const values = [...errors, mean, ...margins].map((value) => value.toPrecision(4))
table.text = texts.map((text, index) => text + (values[index] ?? "")).join("")
